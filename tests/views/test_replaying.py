"""A replay that a page controls, and drivers that are none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skinware import Namespace
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import running
from tests.views.client import page_of
from tests.views.conftest import Serve


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A second of a small skin."""
    file = tmp_path / "torso.mcap"
    with publishing(FakeSkin("torso", fake_structure(1, 2))):
        recorder = Recorder(Files(file))
        recorder.run(1.0)
    return file


@contextmanager
def replaying(file: Path, namespace: Namespace) -> Iterator[None]:
    with running("skin-replay", str(file), "--loop", "--namespace", namespace.name) as replay:
        replay.wait_for("ready")
        yield


@pytest.mark.thorough
def test_all_that_a_page_can_ask_for(serving: Serve, recording: Path, namespace: Namespace) -> None:
    with replaying(recording, namespace), serving() as url, page_of(url) as page:
        page.pull_until(lambda _: page.replays)
        assert page.replays[0]["file"] == str(recording)
        assert page.replays[0]["loop"]
        assert 0.5 < page.replays[0]["duration_s"] < 5
        page.say("replay", action="pause")
        page.pull_until(lambda _: page.replays[0]["paused"])
        page.say("replay", action="seek", value=0.5)
        page.pull_until(lambda _: abs(page.replays[0]["time_s"] - 0.5) < 0.01)
        for _ in range(3):
            page.pull()  # what was there before the pause
        page.say("replay", action="step")
        page.pull_picture()
        page.say("replay", action="step", value=-1)
        page.say("replay", action="speed", value=0.25)
        page.say("replay", action="loop", value=False)
        page.pull_until(lambda _: page.replays[0]["speed"] == 0.25)
        page.pull_until(lambda _: not page.replays[0]["loop"])
        page.say("replay", action="speed", value=-1)
        assert "a speed is at least" in page.pull_until(lambda turn: "error" in turn)["error"]
        page.say("replay", action="resume")
        page.pull_until(lambda _: not page.replays[0]["paused"])
    with publishing(FakeSkin("torso", fake_structure(1, 2))), serving() as url, page_of(url) as page:
        for _ in range(20):
            page.pull()
        assert page.replays == []


def test_a_driver_that_lives_is_no_replay(serving: Serve) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))), serving() as url, page_of(url) as page:
        page.pull_picture()
        page.say("replay", action="pause")
        assert page.pull_until(lambda turn: "error" in turn)["error"] == "no replay is shown"
        page.state = {}
        page.pull_until(lambda _: page.state)
        assert page.replays == []
