"""The page from inside a program: in a cell, of a recording, and with functions of the program in its plots."""

from __future__ import annotations

import urllib.request
from contextlib import AbstractContextManager, closing
from pathlib import Path

import pytest

import skinware
import skinware.recording
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.recording.rig import recording
from tests.views.client import page_of
from tests.views.test_plots import plotted


def torso() -> AbstractContextManager[FakeSkin]:
    return publishing(FakeSkin("torso", fake_structure(1, 2)), 100)


def test_a_cell_shows_the_page() -> None:
    with torso(), closing(skinware.view("torso", height=300)) as view:
        html = view._repr_html_()
        assert f'<iframe src="{view.url}"' in html
        assert "height: 300px" in html
        with urllib.request.urlopen(view.url, timeout=60) as answer:
            assert b"<!doctype html>" in answer.read().lower()
            allowed = answer.headers["Content-Security-Policy"].partition("frame-ancestors ")[2].split()
        assert "http://localhost:*" in allowed
        assert "'none'" not in allowed
        with page_of(view.url) as page:
            page.pull_picture()
            assert [driver["name"] for driver in page.skin["drivers"]] == ["torso"]
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(view.url, timeout=60)


def test_a_function_of_the_program_is_a_line() -> None:
    with (
        torso(),
        closing(skinware.view()) as view,
        skinware.DriverReader("torso") as reader,
        page_of(view.url) as page,
    ):
        view.plot("most", lambda snapshot: snapshot.physical("pressure").max(), unit="counts")
        view.plot("broken", lambda snapshot: 1 / 0)
        page.pull_picture()
        page.pull_until(lambda _: page.state.get("functions"))
        assert page.state["functions"][0] == {"name": "most", "driver": 0, "unit": "counts"}
        page.say("plot", number=1, lines=[{"driver": 0, "function": name} for name in ("most", "broken", "none")])
        seen = {}
        for frame in reader.in_order(timeout_s=5):
            seen[frame.published_ns] = float(frame.physical("pressure").max())
            if len(seen) == 50:
                break
        found = plotted(page, 50)
        common = found[0].keys() & seen.keys()
        assert len(common) > 20
        assert {time: found[0][time] for time in common} == {time: seen[time] for time in common}
        assert all(value != value for value in found[1].values())  # NaN
        assert 2 not in found
        page.state = {}
        page.pull_until(lambda _: page.state)
        assert "broken: ZeroDivisionError: division by zero" in [one["text"] for one in page.state["problems"]]


@pytest.mark.thorough
def test_a_cell_records_into_the_folder_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with torso(), closing(skinware.view("torso")) as view, page_of(view.url) as page:
        page.say("record", action="start")
        page.pull_until(lambda _: (page.state.get("recording") or {}).get("bytes"))
        page.say("record", action="stop")
        page.pull_until(lambda _: page.state["recording"] is None)
    (file,) = tmp_path.glob("*.mcap")
    with skinware.recording.open(file) as opened:
        assert opened.drivers == ("torso",)


def test_a_recording_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    with torso() as skin, recording(file):
        begin = skin.writer.sequence
        wait_until(lambda: skin.writer.sequence > begin + 50)
    with closing(skinware.view(file)) as view:
        assert view.url.endswith(f"?recording={file}")
        with page_of(view.url) as page:
            page.pull_until(lambda _: page.replays)
            assert page.replays[0]["file"] == str(file)
            page.pull_until(lambda _: page.skin["drivers"])
            assert [driver["name"] for driver in page.skin["drivers"]] == ["torso"]
