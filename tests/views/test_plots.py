"""The values of plots are those of the ring, each sample once; marks go into the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader, Namespace, Status
from skinware.memory.namespace import Namespace as Place
from skinware.tactile.contacts_service import ContactsWriter
from skinware.views import plots
from skinware.views.following import Follower, Origin
from skinware.views.looks import Line
from skinware.views.plots import PlotBlock, Plots
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.tactile.skins import AT_ONCE
from tests.views.client import Page, page_of
from tests.views.conftest import Serve

TAXEL, MODULE, CONTACT = {"position": 3}, {"type": "pressure", "modules": [1]}, {"contact": 1}


def plotted(page: Page, count: int) -> dict[int, dict[int, float]]:
    """Values by time of each line, once the first has so many."""
    found: dict[int, dict[int, float]] = {}

    def take(turn: Any) -> bool:
        for block in turn.header.get("plots", {}).get("blocks", ()):
            times, values = turn.array(block["time_ns"], "q"), turn.array(block["values"], "d")
            for line, column in zip(block["lines"], values.reshape(len(times), -1).T, strict=True):
                found.setdefault(line, {}).update(zip(times.tolist(), column.tolist(), strict=True))
        return len(found.get(0, ())) >= count

    page.pull_until(take)
    return found


def test_values_are_those_of_the_ring(serving: Serve) -> None:
    skin = FakeSkin("torso", fake_structure(1, 2))
    with publishing(skin, 200), serving() as url, page_of(url) as page, DriverReader("torso") as reader:
        page.pull_picture()
        page.say("plot", number=5, lines=[{"driver": 0, **line} for line in (TAXEL, MODULE)])
        seen = {}
        for frame in reader.in_order(timeout_s=5):
            pressure = 255.0 - frame.values.astype(float)
            seen[frame.published_ns] = pressure[3], pressure[12:22].sum()
            if len(seen) == 100:
                break
        found = plotted(page, 60)
        for line in (0, 1):
            common = found[line].keys() & seen.keys()
            assert len(common) > 50
            assert {time: found[line][time] for time in common} == {time: seen[time][line] for time in common}
        blocks = page.pull_until(lambda turn: "plots" in turn)["plots"]["blocks"]
        assert {block["number"] for block in blocks} == {5}
        page.say("plot", number=6, lines=[])
        page.pull()
        assert "plots" not in page.pull().header


def test_each_sample_comes_once_and_a_gap_is_seen(namespace: Namespace) -> None:
    skin = FakeSkin("torso", fake_structure(1, 2), slots=8)
    follower = Follower(Origin(namespace))
    skin.publish()
    follower.take(0)
    lines = Plots(follower)
    lines.choose(1, [Line(0, position=3)], follower.edition)
    lines.take()
    lines.blocks()
    for count in (3, 20):  # more than the ring has
        for _ in range(count):
            skin.publish()
        lines.take()
        (block,) = lines.blocks()
        values = block.values[:, 0]
        assert (np.diff(block.time_ns) > 0).all()
        assert np.isnan(values).sum() == (count == 20)
        assert np.isfinite(values).sum() + lines.missed == count
    skin.publish()
    lines.take()
    nothing = Line(0, type="force", modules=(1,))
    lines.choose(2, [Line(0, position=4), nothing, Line(0, position=3)], follower.edition)  # what waits is not lost
    skin.publish()
    lines.take()
    blocks = lines.blocks()
    assert [(block.number, block.lines, len(block.time_ns)) for block in blocks] == [
        (1, [0], 1),
        (2, [0], 1),
        (2, [0, 1, 2], 1),
    ]
    skin.status[3] = Status.STALE
    skin.publish()
    lines.take()
    assert np.isnan(lines.blocks()[0].values).tolist() == [[False, True, True]]
    lines.close()
    follower.close()
    skin.close()


def test_memory_is_bounded_however_slow_a_page_is(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "_MOST_SAMPLES", 50)
    skin = FakeSkin("torso", fake_structure(1, 2))
    follower = Follower(Origin(namespace))
    skin.publish()
    follower.take(0)
    lines = Plots(follower)
    lines.choose(1, [Line(0, position=3)], follower.edition)
    for _ in range(200):
        skin.publish()
        lines.take()
    past, block = lines.blocks()
    assert (len(past.time_ns), len(block.time_ns), lines.missed) == (1, 50, 150)
    lines.close()
    follower.close()
    skin.close()


def test_the_load_of_a_contact_and_the_sum_of_what_is_calm(namespace: Namespace, calm_namespace: Place) -> None:
    structure = fake_structure(1, 2)
    raw, calm = FakeSkin("torso", structure), FakeSkin("torso", structure, calm_namespace)
    calm.values = np.full(24, 255)  # 0 counts
    calm.values[[12, 13]] = 255 - 60
    follower = Follower(Origin(namespace, calm=calm_namespace))
    with ContactsWriter(structure, driver="torso", tracking=AT_ONCE, namespace=calm_namespace) as contacts:
        value = np.zeros(20, np.float32)
        value[[2, 3]] = 60
        contacts.publish(value, value > 0, 10**9)
        raw.publish()
        calm.publish()

        def is_calm() -> bool:
            follower.take(0)
            return bool(follower.drivers and follower.drivers[0].newest and follower.drivers[0].newest.calm)

        wait_until(is_calm)
        wait_until(lambda: follower.take(0) is not None and follower.origins[0].contacts_reader("torso") is not None)
        lines = Plots(follower)
        lines.choose(1, [Line(0, type="pressure", modules=(1,)), Line(0, contact=1)], follower.edition)
        lines.take()
        found: dict[str, PlotBlock] = {block.of: block for block in lines.blocks()}
        assert found["calm"].values.ravel().tolist() == [120.0]
        assert found["contacts"].values.ravel().tolist() == [120.0]
        lines.close()
    for one in (raw, calm, follower):
        one.close()


@pytest.mark.thorough
def test_a_mark_is_an_event_of_the_recording(serving: Serve, page_folder: Path) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))), serving() as url, page_of(url) as page:
        page.say("mark", text="before")
        page.say("record", action="start")
        page.pull_until(lambda _: (page.state.get("recording") or {}).get("bytes"))
        page.say("mark", text="grasp 1")
        page.pull_until(lambda _: len(page.state["marks"]) == 2)
        before, mark = page.state["marks"]
        assert (before["is_recorded"], mark["is_recorded"], mark["text"]) == (False, True, "grasp 1")
        page.say("record", action="stop")
        page.pull_until(lambda _: page.state["recording"] is None)
    (file,) = page_folder.glob("*.mcap")
    with skinware.recording.open(file) as recording:
        (event,) = [event for event in recording.events if event["event"] == "mark"]
        assert (event["text"], event["time_ns"]) == ("grasp 1", int(mark["time_ns"]))
        assert 0 <= event["time_s"] <= recording.duration_s
