"""A recording that a page begins and ends."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

import skinware.recording
from skinware import Namespace
from skinware.memory.announcement import sweep
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import running
from tests.views.client import Page, page_of
from tests.views.conftest import Serve


def pull_state(page: Page, name: str) -> object:
    """What the next state says."""
    page.state = {}
    page.pull_until(lambda _: page.state)
    return page.state[name]


@pytest.mark.thorough
def test_it_is_begun_and_ended_by_any_viewer(serving: Serve, page_folder: Path) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))), serving() as url, page_of(url) as one:
        assert pull_state(one, "recording") is None
        one.say("record", action="start")
        one.say("record", action="start")  # it goes on
        one.pull_until(lambda _: (one.state.get("recording") or {}).get("bytes"))
        with page_of(url) as other:
            told = pull_state(other, "recording")
            assert isinstance(told, dict)
            assert told["missed"] == 0
            assert told["s"] > 0
            other.say("record", action="stop")
            other.pull_until(lambda _: pull_state(other, "recording") is None)
        file = Path(told["file"])
        assert file.parent == page_folder
        with skinware.recording.open(file) as opened:
            assert sum(1 for _ in opened["torso"].samples()) > 1
        assert one.state["problems"] == []


@pytest.mark.thorough
def test_it_ends_whole_with_the_server(serving: Serve, page_folder: Path) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))):
        with serving() as url, page_of(url) as page:
            page.say("record", action="start")
            page.pull_until(lambda _: (page.state.get("recording") or {}).get("bytes"))
        (file,) = page_folder.glob("*.mcap")
        with skinware.recording.open(file) as opened:
            assert opened.is_whole


@pytest.mark.thorough
def test_it_ends_whole_when_the_server_is_killed(
    tmp_path: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with publishing(FakeSkin("torso", fake_structure(1, 2))):
        with ExitStack() as stack:
            view = stack.enter_context(running("skin-view", "--port", "0", "--no-browser"))
            page = stack.enter_context(page_of(view.wait_for("ready")["url"]))
            page.say("record", action="start")
            page.pull_until(lambda _: (page.state.get("recording") or {}).get("bytes"))
            os.kill(view.process.pid, signal.SIGKILL)
        (file,) = tmp_path.glob("*.mcap")

        def is_whole() -> bool:
            with skinware.recording.open(file) as opened:
                return opened.is_whole

        wait_until(is_whole)
    sweep(namespace)


@pytest.mark.parametrize("program", ["raise SystemExit('no space')", "print('{}'); raise SystemExit('no space')"])
def test_why_it_failed_is_told(serving: Serve, program: str) -> None:
    with serving(program=(sys.executable, "-c", program)) as url, page_of(url) as page:
        page.say("record", action="start")
        page.pull_until(lambda _: page.state.get("problems"))
        assert page.state["problems"] == [{"severity": "error", "driver": None, "text": "recording: no space"}]
        assert page.state["recording"] is None
