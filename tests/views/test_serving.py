"""What a page gets of drivers that come, change, die and come back."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import ExitStack, closing
from typing import cast

import numpy as np
import pytest
from websockets.asyncio.server import ServerConnection

from skinware import Namespace, Status
from skinware.geometry import Geometry
from skinware.realtime import now_ns
from skinware.sensor_types import FORCE
from skinware.tactile.contacts_service import ContactsWriter
from skinware.views import history, looks
from skinware.views.access import Access
from skinware.views.following import Follower, Origin
from skinware.views.quantities import levels_of
from skinware.views.robot import Robot
from skinware.views.server import ViewServer
from skinware.views.shows import Show
from skinware.views.turns import PROTOCOL, Viewer
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.tactile.skins import AT_ONCE, triangles
from tests.views.client import Page, page_of
from tests.views.conftest import Serve
from tests.views.test_scene import structure_of


def types(page: Page, driver: int = 0) -> dict[str, dict[str, object]]:
    (found,) = (one for one in page.skin["drivers"] if one["id"] == driver)
    return {one["name"]: one for one in found["types"]}


def drivers(page: Page) -> list[str]:
    return [driver["name"] for driver in page.skin["drivers"]]


def test_a_skin_as_it_is(serving: Serve, namespace: Namespace) -> None:
    with publishing(FakeSkin("torso")) as skin, serving() as url, page_of(url) as page:
        turn = page.pull_until(lambda turn: turn.header.get("skin", {}).get("drivers"))
        assert turn["skin"]["protocol"] == PROTOCOL
        assert turn["skin"]["namespaces"] == [namespace.name]
        (driver,) = turn["skin"]["drivers"]
        assert (driver["name"], driver["type"]) == ("torso", "fake")
        assert [patch["name"] for patch in driver["patches"]] == ["board 7", "board 8", "board 9", "board 10"]
        assert driver["modules"][17] == {"name": "board 8, triangle 1", "patch": 1}
        pressure = driver["types"][0]
        assert [t["name"] for t in driver["types"]] == ["pressure", "temperature"]
        assert (pressure["unit"], pressure["n"]) == ("counts", 640)
        structure, where = skin.structure, skin.structure.index("pressure")
        assert np.array_equal(turn.array(pressure["index"], "I"), np.arange(768)[where])
        assert np.array_equal(turn.array(pressure["uid"], "Q"), structure.sensor_uid[where])
        assert np.array_equal(turn.array(pressure["patch"], "H"), structure.sensor_patch[where])
        assert np.array_equal(turn.array(pressure["module"], "H"), structure.sensor_module[where])
        position = turn.array(pressure["position"], "f").reshape(-1, 3)
        assert len(np.unique(position, axis=0)) == 640
        assert not pressure["placed"]
        assert np.array_equal(turn.array(pressure["normal"], "f").reshape(-1, 3), [[0, 0, 1]] * 640)


def test_raw_levels_are_the_values(serving: Serve) -> None:
    skin = FakeSkin("torso")
    skin.values = np.arange(768) % 256
    skin.status[5] = Status.NEVER_SEEN
    skin.status[6] = Status.OUT_OF_RANGE
    with publishing(skin), serving() as url, page_of(url) as page:
        picture = page.pull_picture()
        where = skin.structure.index("pressure")
        physical = (255 - skin.values)[where]
        expected = np.round(physical / 255 * 250)
        expected[5] = 255
        assert np.abs(picture["levels"] - expected).max() <= 1
        assert picture["levels"][5] == 255
        assert picture["scale"] == [0.0, 255.0]
        assert np.array_equal(page.status[0, "pressure"], skin.status[where])
        page.say("look", mode="raw", type="temperature", scale=[0, 100])
        picture = page.pull_picture(condition=lambda picture: picture["type"] == "temperature")
        values = skin.values[skin.structure.index("temperature")] * 0.5
        assert np.abs(picture["levels"] - np.clip(np.round(values * 2.5), 0, 250)).max() <= 1


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "i4", "f4"])
def test_levels_are_those_of_physical_values(serving: Serve, dtype: str) -> None:
    skin = FakeSkin("torso", fake_structure(dtype=dtype))
    skin.values = np.arange(768) % 100 - (0 if dtype.startswith("u") else 50)
    skin.status[::7] = Status.NOT_CONNECTED
    where = skin.structure.index("temperature")
    with publishing(skin), serving() as url, page_of(url) as page:
        page.say("look", type="temperature", scale=[-11, 17])
        levels = page.pull_picture(condition=lambda picture: picture["type"] == "temperature")["levels"]
        physical = skin.structure.physical(skin.values.astype(dtype), "temperature")
        assert np.array_equal(levels, levels_of(physical, skin.status[where], -11, 17))
        assert len(set(levels.tolist())) > 10


def test_status_is_sent_when_it_changes(serving: Serve) -> None:
    with publishing(FakeSkin("torso")) as skin, serving() as url, page_of(url) as page:
        page.pull_picture(condition=lambda picture: "status" in picture)
        assert "status" not in page.pull_picture()
        skin.status[7] = Status.NO_ACK
        picture = page.pull_picture(condition=lambda picture: "status" in picture)
        assert picture["status"][7] & Status.NO_ACK
        assert picture["levels"][7] == 255


@pytest.mark.thorough
def test_a_killed_driver_is_shown_and_one_that_comes_back_too(serving: Serve) -> None:
    with serving() as url, page_of(url) as page:
        with fake_process("torso", "--patches", "1") as process:
            page.pull_picture()
            kill(process)
            turn = page.pull_until(lambda turn: (picture := turn.picture()) and "status" in picture)
            assert (turn.picture() or {})["status"].all()  # stale, all of them
            page.pull_until(lambda _: page.state["drivers"] and page.state["drivers"][0]["state"] == "dead")
            assert page.state["problems"][0]["severity"] == "error"
            with publishing(FakeSkin("torso", fake_structure(1))):
                page.pull_until(lambda _: page.state["drivers"] and page.state["drivers"][0]["state"] == "live")
                assert page.skin["drivers"][0]["id"] == 0
                wait_until(lambda: page.pull() is not None and not page.status[0, "pressure"].any())
        page.pull_until(lambda _: page.skin["drivers"] == [])


def test_another_structure_comes_whole(serving: Serve) -> None:
    with FakeSkin("torso", fake_structure(1)) as skin, serving() as url, page_of(url) as page:
        skin.publish()
        page.pull_picture()
        first = page.skin["drivers"][0]["generation"]
        skin.structure = fake_structure(2)
        skin.status = np.zeros(skin.structure.n_sensors, np.uint8)
        skin.writer.restructure(skin.structure)
        for name in ("patch_state", "patch_counters", "interval_counts", "age_counts"):
            setattr(skin, name, np.repeat(getattr(skin, name), 2, axis=0))
        skin.publish()
        page.pull_until(lambda _: len(page.skin["drivers"][0]["patches"]) == 2)
        assert page.skin["drivers"][0]["generation"] != first
        assert len(page.pull_picture(condition=lambda picture: len(picture["levels"]) == 320)["levels"]) == 320


def test_no_driver_at_all(serving: Serve, namespace: Namespace) -> None:
    with serving() as url, page_of(url) as page:
        turn = page.pull()
        assert turn["skin"]["drivers"] == []
        assert turn["state"]["drivers"] == []
        with publishing(FakeSkin("torso")):
            page.pull_picture()


def test_only_those_that_are_named(serving: Serve) -> None:
    with ExitStack() as stack:
        for name in ("arm", "leg", "torso"):
            stack.enter_context(publishing(FakeSkin(name, fake_structure(1, 2))))
        page = stack.enter_context(page_of(stack.enter_context(serving(("arm", "torso")))))
        page.pull_until(lambda _: page.skin["drivers"])
        assert drivers(page) == ["arm", "torso"]


def test_names_and_values(serving: Serve) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))) as skin, serving() as url, page_of(url) as page:
        page.pull_picture()
        page.say("names", driver=0, type="pressure")
        page.say("exact", sensors=[[0, 3], [0, 11], [5, 3], [0, 99_999]])
        turn = page.pull()
        assert turn["names"]["of"][3] == "board 7, triangle 0, taxel 3"
        assert turn["names"]["of"][10] == "board 7, triangle 1, taxel 0"
        skin.values = np.full(24, 200)
        turn = page.pull_until(lambda turn: "exact" in turn and turn["exact"][0]["raw"] == 200)
        pressure, temperature = turn["exact"]  # the others are not there
        assert (pressure["position"], pressure["value"], pressure["status"]) == (3, 55.0, 0)
        assert (temperature["position"], temperature["value"]) == (11, 100.0)
        assert pressure["age_ms"] >= 0


def test_changes_peaks_and_wipes(serving: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    skin = FakeSkin("torso", fake_structure(1, 2))
    skin.values = np.full(24, 240)
    touched = skin.values.copy()
    touched[4:8] = 140
    monkeypatch.setattr(history, "SETTLING_S", 0.1)
    with publishing(skin), serving() as url, page_of(url) as page:
        page.say("look", mode="change")
        for _ in range(5):
            assert not page.pull_picture(condition=lambda picture: picture["scale"][1] < 100)["levels"].any()
        skin.values = touched
        picture = page.pull_picture(condition=lambda picture: picture["levels"].any())
        assert np.flatnonzero(picture["levels"]).tolist() == [4, 5, 6, 7]
        page.say("look", mode="peak")
        page.pull_picture(condition=lambda picture: picture["levels"][4] > 100)
        skin.values = np.full(24, 240)
        for _ in range(5):
            assert page.pull_picture()["levels"][4] > 100
        page.say("tare")
        page.pull_picture(condition=lambda picture: not picture["levels"].any())
        page.say("look", mode="wipe")
        page.pull_until(lambda turn: turn.header.get("mode") == "wipe")
        assert not page.pull_picture()["levels"].any()
        skin.values = touched
        page.pull_picture(condition=lambda picture: picture["levels"].any())
        skin.values = np.full(24, 240)
        picture = page.pull_picture()
        assert np.flatnonzero(picture["levels"] == 250).tolist() == [4, 5, 6, 7]
        page.say("wipe", action="start")
        page.pull_picture(condition=lambda picture: not picture["levels"].any())


def test_what_is_calm_and_its_contacts(serving: Serve, calm_namespace: Namespace) -> None:
    structure = fake_structure(1, 2)
    geometry = Geometry.unknown(["pressure"] * 20, structure.sensor_uid[structure.index("pressure")])
    geometry.position_m[:], geometry.normal[:], geometry.frame[:] = triangles(2, 10), (0, 0, 1), "arm"
    structure = structure.placed(geometry)
    raw, calm = FakeSkin("torso", structure), FakeSkin("torso", structure, calm_namespace)
    raw.values = np.full(24, 100)
    calm.values = np.full(24, 255)  # 0 counts
    calm.values[[2, 3]] = 255 - 60
    calm.status[9] = Status.UNHEALTHY
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    with (
        publishing(raw),
        publishing(calm),
        ContactsWriter(structure, driver="torso", tracking=AT_ONCE, namespace=calm_namespace) as contacts,
        serving((), calm_namespace, robot=Robot({"arm": pose})) as url,
        page_of(url) as page,
    ):
        value = np.zeros(20, np.float32)
        value[[2, 3]] = 60
        contacts.publish(value, value > 0, 10**9)
        page.say("look", mode="change")
        (contact,) = page.pull_picture(condition=lambda picture: picture["contacts"])["contacts"]
        assert contact["kind"] == "touch"
        assert contact["load"] == pytest.approx(120)
        middle = geometry.position_m[[2, 3]].mean(axis=0) + np.array([1, 2, 3])
        assert contact["position"] == pytest.approx(middle.tolist(), abs=1e-6)
        picture = page.pull_picture(condition=lambda picture: picture["levels"][2] > 100)
        assert np.flatnonzero(picture["levels"]).tolist() == [2, 3]
        assert picture["totals"].tolist() == [120, 0]  # by module
        assert page.status[0, "pressure"][9] & Status.UNHEALTHY
        assert types(page)["pressure"]["placed"]
        assert {name: told["touch"] for name, told in types(page).items()} == {"pressure": True, "temperature": False}


def test_shear_is_how_far_two_axes_are_from_rest(serving: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "SETTLING_S", 0.1)
    skin = FakeSkin("finger", structure_of([(0, "2x3", 6)], FORCE))
    skin.values = np.arange(18) * 10
    with publishing(skin), serving() as url, page_of(url) as page:
        for _ in range(5):
            assert not page.pull_picture()["shear"].any()
        skin.values = skin.values + np.where(np.arange(18) == 9, 50, 0) - np.where(np.arange(18) == 10, 100, 0)
        picture = page.pull_picture(condition=lambda picture: picture["longest_shear"] > 100)
        assert np.flatnonzero(picture["shear"].any(axis=1)).tolist() == [3]
        x, y = picture["shear"][3] / 127 * picture["longest_shear"]
        assert (x, y) == (pytest.approx(50, abs=3), pytest.approx(-100, abs=3))
        assert picture["type"] == "force"


def test_two_look_differently_at_the_same(serving: Serve) -> None:
    with publishing(FakeSkin("torso")), serving() as url, page_of(url) as one, page_of(url) as other:
        one.say("look", mode="raw", type="pressure", scale=[0, 255])
        other.say("look", mode="raw", type="temperature", scale=[0, 50])
        for _ in range(3):
            assert one.pull_picture(condition=lambda picture: picture["scale"] == [0, 255])["type"] == "pressure"
            assert other.pull_picture(condition=lambda picture: picture["scale"] == [0, 50])["type"] == "temperature"


def test_a_scale_of_its_own_where_the_range_is_not_known(serving: Serve) -> None:
    with publishing(FakeSkin("torso")) as skin, serving() as url, page_of(url) as page:
        skin.values = np.full(768, 10)
        page.say("look", type="temperature")
        page.pull_picture(condition=lambda picture: picture["scale"][0] <= 5.0)
        skin.values = np.full(768, 30)
        low, high = page.pull_picture(condition=lambda picture: picture["scale"][1] >= 15.0)["scale"]
        assert low <= 5
        assert high >= 15


def test_a_snapshot_is_looked_for_when_a_turn_is_due_or_a_ring_would_lose_it(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most five times a second without a viewer, in time for each that waits and for rings that go round fast."""

    async def looks_after_s(
        skin: FakeSkin | None, *, waits: bool = False, is_watched: bool = True
    ) -> tuple[float, float]:
        with closing(Follower(Origin(namespace))) as follower:
            if skin is not None:
                skin.publish()
                follower.take(0)
            server, viewer = ViewServer(follower, Access("127.0.0.1", None)), Viewer(Show(follower))
            server._viewers = {viewer: cast("ServerConnection", None)} if is_watched else {}
            viewer.wanted = int(waits)
            viewer.sent_s = (before_s := time.monotonic())
            server._come_again()
            after_s = time.monotonic()
            due_s = server._timer.when()
            server._timer.cancel()
            return due_s - after_s, due_s - before_s

    def is_about(span: tuple[float, float], expected_s: float) -> bool:
        return span[0] <= expected_s <= span[1]

    assert is_about(asyncio.run(looks_after_s(None, is_watched=False)), 0.2)
    with FakeSkin("slow") as skin:
        assert is_about(asyncio.run(looks_after_s(skin)), 0.2)
        assert is_about(asyncio.run(looks_after_s(skin, waits=True)), 1 / looks.DEFAULT_FPS)
        monkeypatch.setattr(Follower, "slack_s", 0.064)
        assert is_about(asyncio.run(looks_after_s(skin)), 0.032)


def test_state_has_the_tree_and_what_is_wrong(serving: Serve) -> None:
    skin = FakeSkin("torso", fake_structure(4, 2, buses=2))
    skin.break_some()
    skin.bus_load[0] = 250
    with publishing(skin), serving() as url, page_of(url) as page:
        page.pull_picture()
        page.state = {}
        page.pull_until(lambda _: page.state)
        (driver,) = page.state["drivers"]
        assert (driver["state"], driver["sensors"], driver["dropped"], driver["load"]) == ("live", 96, 2, 0.25)
        assert [bus["name"] for bus in driver["buses"]] == ["can0", "can1"]
        assert [patch["bus"] for patch in driver["patches"]] == ["can0", "can0", "can1", "can1"]
        assert driver["patches"][3]["state"] == "stale"
        severities = [problem["severity"] for problem in page.state["problems"]]
        assert severities == sorted(severities, key=["error", "warning", "note"].index)
        texts = [problem["text"] for problem in page.state["problems"]]
        assert any(text.startswith("board 10 is stale") for text in texts)
        assert "1 of 96 sensors never seen" in texts
        stale = next(problem for problem in page.state["problems"] if problem["text"].startswith("board 10 is stale"))
        assert (stale["bus"], stale["patch"]) == ("can1", "board 10")
        lost = next(problem for problem in page.state["problems"] if "frames dropped" in problem["text"])
        assert set(lost) == {"severity", "driver", "text", "since_ns"}  # of none alone
        assert 0 < int(lost["since_ns"]) <= now_ns()
        assert (page.state["recording"], page.replays) == (None, [])
        assert json.dumps(page.state)
