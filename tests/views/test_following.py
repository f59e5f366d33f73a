"""What all viewers look at: drivers that come, go and break, in a namespace that may break too."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from skinware import DriverReader, Namespace, Status
from skinware.errors import ServiceNotFound
from skinware.status import Why
from skinware.views.following import Follower, Origin
from skinware.views.looks import Choose, Look, QuantityPicture
from skinware.views.tree import problems_of
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure


@pytest.fixture(autouse=True)
def look_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.drivers.LOOK_EVERY_NS", 0)
    monkeypatch.setattr("skinware.views.following._LOOK_EVERY_NS", 0)


def names(follower: Follower) -> list[str]:
    return [driver.name for driver in follower.take(0)]


def test_each_frame_is_taken_once(namespace: Namespace) -> None:
    with FakeSkin("b") as skin, FakeSkin("a"), closing(Follower(Origin(namespace))) as follower:
        assert names(follower) == []
        assert [driver.name for driver in follower.drivers] == ["a", "b"]
        skin.publish()
        assert names(follower) == ["b"]
        assert names(follower) == []
        before = follower.drivers[1].changes
        skin.publish(3)
        assert names(follower) == ["b"]
        assert follower.drivers[1].changes == before + 1


@pytest.mark.parametrize("is_calmed", [False, True], ids=["raw", "calmed"])
def test_a_press_between_two_pictures_is_a_peak(
    namespace: Namespace, calm_namespace: Namespace, is_calmed: bool
) -> None:
    structure = fake_structure(1, 2)
    with (
        FakeSkin("a", structure) as raw,
        FakeSkin("a", structure, calm_namespace) as calm,
        closing(Follower(Origin(namespace, calm=calm_namespace if is_calmed else None))) as follower,
    ):
        skin = calm if is_calmed else raw
        skin.values = np.full(24, 255)  # 0 counts
        look = Look()
        look.choose(Choose(mode="peak"))

        def shown(*loads: tuple[int, int]) -> QuantityPicture:
            for positions in [*loads, None]:
                skin.values = np.full(24, 255)
                if positions is not None:
                    skin.values[list(positions)] = 155
                raw.publish()
                calm.publish()
            (driver,) = follower.take(0)
            look.follow(driver)
            picture = look.picture(driver)
            assert picture is not None
            return picture

        assert not shown().levels.any()
        picture = shown((3, 4), (4, 15))
        assert np.flatnonzero(picture.levels).tolist() == [3, 4, 13]  # of pressure
        if is_calmed:  # counts of a patch are a load only above baselines
            assert picture.totals is not None
            assert picture.totals.tolist() == [[200, 0], [100, 100], [0, 0]]
        assert np.flatnonzero(shown().levels).tolist() == [3, 4, 13]  # of pressure


def test_a_calmed_driver_settles_and_its_reasons_are_problems(namespace: Namespace) -> None:
    why = np.full(24, int(Why.RELEARNING), np.uint8)
    why[20:] = Why.REST, Why.HELD, Why.DOUBTED, Why.DOUBTED
    with FakeSkin("a", fake_structure(1, 2), why=why) as skin, closing(Follower(Origin(namespace))) as follower:
        skin.status[:19] = Status.NEVER_SEEN
        skin.publish()
        (driver,) = follower.take(0)
        assert driver.newest is not None
        assert driver.newest.marked.tolist() == [0xFF] * 19 + [0] * 5
        problems = {(problem["severity"], problem["text"]) for problem in problems_of(driver, driver.report())}
    doubted = "2 of 24 sensors fall and return where nothing touches: their polarity may be wrong"
    assert problems == {("note", "settling, 19 left"), ("warning", doubted)}


def test_no_more_often_than_asked_for(namespace: Namespace) -> None:
    with FakeSkin("a") as skin, closing(Follower(Origin(namespace))) as follower:
        skin.publish()
        assert names(follower) == ["a"]
        skin.publish()
        assert follower.take(10**12) == []
        assert names(follower) == ["a"]


def test_numbers_last_over_restarts_and_generations_do_not(namespace: Namespace) -> None:
    with closing(Follower(Origin(namespace))) as follower:
        told = []
        for name in ("b", "a", "b"):
            with FakeSkin(name) as skin:
                skin.publish()
                follower.take(0)
                told.append((follower.drivers[0].number, follower.drivers[0].generation))
            follower.take(0)
            assert follower.drivers == []
        (b, first), (a, _), (again, second) = told
        assert b == again != a
        assert first != second


def test_a_restart_with_the_same_sensors_changes_no_table(namespace: Namespace) -> None:
    with FakeSkin("a") as skin, closing(Follower(Origin(namespace))) as follower:
        skin.publish()
        follower.take(0)
        (driver,), edition, structure = follower.drivers, follower.edition, follower.drivers[0].structure
        skin.writer.restructure(fake_structure())
        skin.publish()
        assert names(follower) == ["a"]
        assert follower.drivers == [driver]
        assert (follower.edition, driver.structure is structure) == (edition, True)


def test_a_driver_that_goes_at_the_worst_moment(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeSkin("a") as skin, closing(Follower(Origin(namespace))) as follower:
        skin.publish()
        follower.take(0)

        def gone(_self: DriverReader) -> None:
            raise ServiceNotFound("gone")

        with monkeypatch.context() as patch:
            patch.setattr(follower.origins[0].live._drivers, "_every_ns", 200_000_000)
            follower.take(0)
            patch.setattr(DriverReader, "refresh", gone)
            assert names(follower) == names(follower) == []
        skin.publish()
        wait_until(lambda: names(follower) == ["a"])


def test_a_namespace_that_cannot_be_trusted_is_a_problem_while_it_is(namespace: Namespace) -> None:
    with FakeSkin("a") as skin, closing(Follower(Origin(namespace))) as follower:
        mode = namespace.path.stat().st_mode
        namespace.path.chmod(0o777)
        assert names(follower) == []
        assert "can be written by others" in (follower.problem or "")
        namespace.path.chmod(mode)
        skin.publish()
        wait_until(lambda: names(follower) == ["a"])
        assert follower.problem is None


def test_the_past_is_ten_seconds(namespace: Namespace) -> None:
    with FakeSkin("a", fake_structure(1, 1)) as skin, closing(Follower(Origin(namespace))) as follower:
        for value in range(5):
            skin.values = np.full(12, value)
            skin.publish()
            follower.take(0)
        past = follower.drivers[0].past
        times_ns, values = past.series(3)
        assert values.tolist() == list(range(5))
        assert (np.diff(times_ns) > 0).all()
        newest_ns = int(times_ns[-1])
        for number in range(1000):
            past.add(np.full(12, number % 2), newest_ns + number * 50_000_000)
        times_ns, values = past.series(0)
        assert 9.9e9 <= times_ns[-1] - times_ns[0] <= 10e9
        assert len(values) == 201
