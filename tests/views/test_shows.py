"""Recordings that pages play: outlined, each for one viewer, beside each other, and files that are none."""

from __future__ import annotations

import os
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinware.recording
from skinware import Namespace
from skinware.memory.namespace import ROOT
from skinware.realtime import now_ns
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from skinware.tactile.contacts_service import ContactsWriter
from skinware.views import recorded_plots
from skinware.views.following import Follower, Origin
from skinware.views.looks import Line
from skinware.views.recorded_plots import RecordedPlots
from skinware.views.shows import Outline, PlayedRecording, RecordingFiles, Show
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.tactile.skins import AT_ONCE
from tests.views.client import Page, page_of
from tests.views.conftest import Serve

LENGTH_S = 1.5


@pytest.fixture
def recording(tmp_path: Path, namespace: Namespace) -> Path:
    """A small skin with two contacts and a mark."""
    file, structure = tmp_path / "walk.mcap", fake_structure(1, 2)
    felt = np.zeros(20, np.float32)
    felt[[2, 13]] = 60
    with (
        publishing(FakeSkin("torso", structure), 50),
        ContactsWriter(structure, driver="torso", tracking=AT_ONCE, namespace=namespace) as contacts,
    ):
        recorder = Recorder(Files(file))
        running = threading.Thread(target=recorder.run, args=(LENGTH_S,))
        running.start()
        recorder.mark("slip", now_ns())
        while running.is_alive():
            contacts.publish(felt, felt > 0, now_ns())
            running.join(0.05)
    return file


@contextmanager
def playing(serving: Serve, *names: str, files: RecordingFiles) -> Iterator[Page]:
    query = "&".join(f"recording={name}" for name in names)
    with serving(files=files) as url, page_of(f"{url}?{query}") as page:
        yield page


def namespaces() -> list[Path]:
    return list(ROOT.glob(f"skinware.view-{os.getpid()}-*"))


def problems(page: Page) -> list[str]:
    page.pull_until(lambda _: page.state)
    return [problem["text"] for problem in page.state["problems"]]


def test_an_outline_counts_what_was_recorded(recording: Path) -> None:
    with skinware.recording.open(recording) as opened:
        outline = Outline(opened)
        parts = sum(1 for _ in outline.steps())
        assert parts > 2
        assert outline.until_s == opened.duration_s
        assert outline.samples.sum() == len(opened["torso"].read())
        assert outline.missed.sum() == opened.missed
        assert outline.contacts is not None
        assert outline.contacts.max() == 2
        (mark,) = outline.events
        assert (mark["event"], mark["text"]) == ("mark", "slip")
        assert 0 <= mark["time_s"] < LENGTH_S


def test_a_moment_shows_what_was_recorded_until_then(serving: Serve, recording: Path) -> None:
    with playing(serving, "walk.mcap", files=RecordingFiles(folder=recording.parent)) as page:
        page.pull_until(lambda _: page.skin and page.skin["drivers"])
        assert page.skin["recordings"] == ["walk"]
        (replay,) = page.replays
        assert (replay["title"], replay["paused"]) == ("walk", True)
        page.say("look", scale=[0, 250], type="pressure")
        with skinware.recording.open(recording) as opened:
            series = opened["torso"].read(type_name="pressure")
            for at in (len(series) // 2, 3, len(series) - 2):
                time_s = float(series.time_s[at]) + 1e-4
                felt = np.rint(np.clip(series.physical("pressure")[at], 0, 250))
                page.say("replay", action="seek", value=time_s)
                picture = page.pull_picture(condition=lambda one, felt=felt: np.array_equal(one["levels"], felt))  # type: ignore[misc]
                assert page.status[0, "pressure"].max() == 0
                page.pull_until(lambda _, time_s=time_s: abs(page.replays[0]["time_s"] - time_s) < 1e-3)  # type: ignore[misc]
                assert page.status[0, "pressure"].max() == 0
        if not picture["contacts"]:  # they are published after the driver
            picture = page.pull_picture(condition=lambda one: one["contacts"])
        assert len(picture["contacts"]) == 2
        for _ in range(4):  # two seconds, in which time stands still
            page.pull()
        assert page.status[0, "pressure"].max() == 0
        assert page.state["drivers"][0]["state"] == "live"
        assert page.state["drivers"][0]["rate_hz"] is None
        page.pull_until(lambda _: page.outlines[0].get("until_s") == replay["duration_s"])
        assert [event["text"] for event in page.outlines[0]["events"]] == ["slip"]
        for op in ("mark", "record"):
            page.say(op, **({"text": "x"} if op == "mark" else {"action": "start"}))
            assert "cannot" in page.pull_until(lambda turn: "error" in turn)["error"]


def test_at_a_paused_moment_nothing_grows_old(recording: Path) -> None:
    played = PlayedRecording(recording, "walk")
    follower = Follower(Origin(played.namespace, recording="walk"))
    with closing(Show(follower, [played])):
        wait_until(lambda: bool(played.namespace.services()))
        time.sleep(0.5)  # longer than a value is fresh
        wait_until(lambda: bool(follower.take(0)))
        (driver,) = follower.drivers
        assert (driver.life, int(driver.status.max())) == ("live", 0)


def test_each_viewer_plays_for_itself_and_leaves_nothing(serving: Serve, recording: Path) -> None:
    files = RecordingFiles([recording])
    with serving(files=files) as url:
        address = f"{url}?recording={recording}"
        with page_of(address) as page, page_of(address) as other:
            page.pull_until(lambda _: page.replays)
            other.pull_until(lambda _: other.replays)
            page.say("replay", action="seek", value=0.5)
            page.pull_until(lambda _: page.replays[0]["time_s"] == 0.5)
            other.say("replay", action="resume")
            other.pull_until(lambda _: other.replays[0]["time_s"] > 0.6)
            page.pull()
            assert page.replays[0]["time_s"] == 0.5
            assert len(namespaces()) == 2
        wait_until(lambda: not namespaces())


def test_plots_are_of_the_recording_whatever_was_played(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_plots, "_BEFORE_S", 0.5)
    monkeypatch.setattr(recorded_plots, "_AHEAD_S", 0.2)
    played = PlayedRecording(recording, "walk")
    follower = Follower(Origin(played.namespace, recording="walk"))
    lines = RecordedPlots(follower, [played])
    found: dict[int, tuple[float, float]] = {}
    loads: set[float] = set()

    def has_read(first_s: float, last_s: float) -> bool:
        follower.take(0)
        lines.take()
        for block in lines.blocks():
            if block.of == "driver":
                if block.begins:
                    found.clear()
                found.update(zip(block.time_ns.tolist(), map(tuple, block.values.tolist()), strict=True))
            else:
                assert block.of == "contacts"
                loads.update(block.values.ravel().tolist())
        return bool(found) and min(found) <= round(first_s * 1e9) and round(last_s * 1e9) <= max(found)

    with closing(Show(follower, [played])), skinware.recording.open(recording) as opened, closing(lines):
        played.act("seek", 1.0, pytest.fail)  # contacts are there then
        wait_until(lambda: follower.take(0) is not None and follower.origins[0].contacts_reader("torso") is not None)
        chosen = [Line(0, position=3), Line(0, type="pressure", modules=(1,)), Line(0, contact=1)]
        lines.choose(1, chosen, follower.edition)
        series = opened["torso"].read(type_name="pressure")
        times = series.time_s
        for now_s, first_s, last_s in (
            (0.0, 0.0, 0.2),
            (0.15, 0.0, 0.35),
            (1.4, 0.9, opened.duration_s),
            (0.9, 0.4, 1.1),
        ):
            played.act("seek", now_s, pytest.fail)
            wait_until(lambda now_s=now_s: played.state["time_s"] == now_s)  # type: ignore[misc]
            within = (times >= first_s) & ((times < last_s) | (last_s == opened.duration_s))
            wait_until(lambda ends=times[within]: has_read(ends[0], ends[-1]))  # type: ignore[misc]
            values = series.physical("pressure")[within]
            assert [one for one, _ in found.values()][-len(values) :] == pytest.approx(values[:, 3].tolist())
            assert list(found.values())[-1][1] == pytest.approx(values[-1, 10:20].sum())
    assert loads == {60.0}


def test_two_beside_each_other_are_two_bodies(serving: Serve, recording: Path) -> None:
    (recording.parent / "again.mcap").write_bytes(recording.read_bytes())
    with playing(serving, "walk.mcap", "again.mcap", files=RecordingFiles(folder=recording.parent)) as page:
        page.pull_until(lambda _: len((page.skin or {"drivers": []})["drivers"]) == 2)
        assert [driver["name"] for driver in page.skin["drivers"]] == ["torso (walk)", "torso (again)"]
        assert [driver["namespace"] for driver in page.skin["drivers"]] == ["walk", "again"]
        page.say("replay", action="seek", value=0.7, number=1)
        page.pull_until(lambda _: page.replays[1]["time_s"] == 0.7)
        assert page.replays[0]["time_s"] == 0
        page.say("replay", action="resume")
        page.pull_until(lambda _: not any(replay["paused"] for replay in page.replays))


def test_a_files_gives_away_recordings_alone(recording: Path) -> None:
    folder = recording.parent
    (folder / "inner").mkdir()
    (folder / "inner/more.mcap").touch()
    (folder / "notes.txt").touch()
    files = RecordingFiles([recording], folder / "inner")
    assert files.find(str(recording)) == recording
    assert files.find("walk.mcap") == recording
    assert files.find("more.mcap") == folder / "inner/more.mcap"
    for name in ("inner/more.mcap", "../walk.mcap", "notes.txt", "gone.mcap", ""):
        assert files.find(name) is None


def test_files_that_are_no_recordings_get_one_line(serving: Serve, recording: Path) -> None:
    folder = recording.parent
    (folder / "foreign.mcap").write_text("hello")
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / "damaged.mcap").write_bytes(data)
    (folder / "cut.mcap").write_bytes(recording.read_bytes()[: len(data) // 2])
    files = RecordingFiles(folder=folder)
    lines: dict[str, Any] = {
        "foreign.mcap": "(not an MCAP file); skin-convert --guess begins with data of others",
        "gone.mcap": "gone.mcap: there is no such file where skin-view was started",
        "cut.mcap": "cut: its end is missing; skin-recover completes it",
        "damaged.mcap": "damaged: 1 chunk damaged and left out",
    }
    with serving(files=files) as url:
        for name, line in lines.items():
            with page_of(f"{url}?recording={name}") as page:
                page.pull_until(lambda _, page=page, line=line: any(text.endswith(line) for text in problems(page)))  # type: ignore[misc]
        for name, size in (("walk.mcap", recording.stat().st_size), ("gone.mcap", -1)):
            with closing(urllib.request.urlopen(f"{url}recordings/{name}")) as answer:
                assert int(answer.read()) == size
    with playing(serving, *["walk.mcap"] * 5, files=files) as page:
        assert "at most 4 recordings are shown at once" in problems(page)
