from __future__ import annotations

from contextlib import closing
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from skinware import Namespace, ServiceWriter
from skinware.realtime import now_ns
from skinware.views.live import LiveDriver, LiveDrivers
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill
from tests.specification import ring


@pytest.fixture(autouse=True)
def look_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.drivers.LOOK_EVERY_NS", 0)


def names(drivers: LiveDrivers) -> list[str]:
    return [driver.name for driver in drivers.look()]


def test_drivers_come_and_go() -> None:
    with closing(LiveDrivers(Namespace())) as drivers:
        assert drivers.look() == []
        with FakeSkin("b"), FakeSkin("a"), ServiceWriter("contacts", {"force": ("f4", 3)}):
            assert names(drivers) == ["a", "b"]
            assert drivers.get("a") is not None
            assert drivers.get("contacts") is None
        assert names(drivers) == []
        assert drivers.get("a") is None


def test_poll_tells_of_newer_frames_only() -> None:
    with FakeSkin("a") as skin, closing(LiveDrivers(Namespace())) as drivers:
        (driver,) = drivers.look()
        assert (drivers.poll(driver), driver.frame) == (False, None)
        skin.publish(2)
        assert drivers.poll(driver)
        assert driver.frame is not None
        assert driver.frame.sequence == 2
        assert not drivers.poll(driver)
        assert driver.report().life == "live"


@pytest.mark.thorough
def test_a_dead_driver_stays_until_its_file_goes() -> None:
    with closing(LiveDrivers(Namespace())) as drivers:
        with fake_process("a", "--patches", "1") as process:
            (driver,) = drivers.look()
            assert drivers.poll(driver)
            kill(process)
            assert names(drivers) == ["a"]
            drivers.poll(driver)
            assert driver.report().life == "dead"
        assert names(drivers) == []


def test_a_driver_may_come_back_changed() -> None:
    with closing(LiveDrivers(Namespace())) as drivers:
        with FakeSkin("a", fake_structure(1, 2)) as skin:
            skin.publish()
            (driver,) = drivers.look()
            assert drivers.poll(driver)
        with FakeSkin("a", fake_structure(1, 3)) as again:
            drivers.poll(driver)
            assert driver.reader.structure.n_sensors == 36
            assert driver.report().life in ("live", "starting")
            again.publish()
            assert drivers.poll(driver)
            assert driver.frame is not None
            assert driver.frame.structure.n_sensors == 36


def test_what_cannot_be_read_any_more_is_dropped() -> None:
    with closing(LiveDrivers(Namespace())) as drivers:
        with FakeSkin("a") as skin:
            skin.publish()
            (driver,) = drivers.look()
        with ServiceWriter("a", {"force": ("f4", 3)}) as other:
            other.begin()
            other.commit(0)
            assert not drivers.poll(driver)
            assert names(drivers) == []


def test_two_frames_at_once_right_after_a_start_make_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    ring.use_specification(monkeypatch)  # C has a clock of its own
    with FakeSkin("a", slots=8) as skin, closing(LiveDrivers(Namespace())) as drivers:
        clock_ns = now_ns()
        monkeypatch.setattr(ring, "now_ns", lambda: clock_ns)
        skin.acquired_ns = clock_ns  # no interval of the data counts
        skin.publish()
        clock_ns += 44_000
        skin.publish()
        (driver,) = drivers.look()
        assert drivers.poll(driver)
        assert driver.rate_hz is None
        clock_ns += 999_956_000
        skin.publish()
        assert driver.rate_hz == 2.0
        for _ in range(7):
            clock_ns += 1_000_000
            skin.publish()
        assert driver.rate_hz == 1000.0  # a ring that is full is enough, however fast it was filled


def test_the_rate_is_measured_over_two_seconds() -> None:
    reader = SimpleNamespace(rate_hz=lambda: 7.0, name="a", structure=fake_structure(2, 2))
    driver = LiveDriver(cast(Any, reader))

    def take(sequence: int, published_ns: int, generation: int = 1) -> None:
        counts = np.zeros((2, 32), np.uint64)
        counts[:, 5] = 2 * sequence, sequence // 2  # the second patch has half as many
        frame = SimpleNamespace(
            sequence=sequence,
            published_ns=published_ns,
            generation=generation,
            patch_interval_counts=counts,
            structure=fake_structure(2, 2),
        )
        driver.take(cast(Any, frame))

    assert driver.rate_hz == 7.0  # that of the ring
    assert driver.patch_rates_hz == [None, None]
    for tenth in range(50):
        take(2 * tenth + 1, tenth * 100_000_000)  # every other frame at 20 Hz
    assert driver.rate_hz == pytest.approx(20.0)
    assert driver.patch_rates_hz == pytest.approx([20.0, 5.0])
    assert len(driver._counts) <= 21
    for tenth in range(50, 100):
        take(4 * tenth, tenth * 100_000_000)  # then at 40 Hz
    assert driver.rate_hz == pytest.approx(40.0)
    take(0, 10 * 10**9, generation=2)
    take(0, 11 * 10**9, generation=2)
    assert driver.patch_rates_hz == [None, None]  # nobody counts
    driver._counts.clear()
    take(1, 12 * 10**9, generation=2)
    assert driver.rate_hz == 7.0
