"""``skin-driver`` with a driver whose code has a fault: one line, exit status 1, never a process that does nothing."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest

from tests.commands import run, running

DRIVER = """
import asyncio
from skinware_drivers.can.roboskin import RoboskinDriver


class MySkin(RoboskinDriver):
    def __init__(self, options):
        {init}
        super().__init__(options)

    async def start(self, link):
        {start}
        await super().start(link)
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("place", "fault", "words"),
    [
        (
            "start",
            'raise KeyError("oops")',
            "bus virtual:roboskin: `start` failed: KeyError: 'oops' (my_skin.py, line 12)",
        ),
        (
            "init",
            'raise KeyError("oops")',
            "bus virtual:roboskin: `__init__` failed: KeyError: 'oops' (my_skin.py, line 8)",
        ),
        ("start", "raise SystemExit(0)", "bus virtual:roboskin: `start` failed: SystemExit: 0 (my_skin.py, line 12)"),
        (
            "start",
            'asyncio.get_running_loop().call_soon({}.__getitem__, "oops")',
            "the driver failed: KeyError: 'oops' (events.py, line N)",
        ),
        (
            "start",
            'asyncio.ensure_future(asyncio.to_thread({}.__getitem__, "oops"))',
            "the driver failed: KeyError: 'oops' (thread.py, line N)",
        ),
    ],
)
def test_it_ends_with_one_line(place: str, fault: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "my_skin.py"
    path.write_text(DRIVER.format(**{"init": "pass", "start": "pass", place: fault}))
    done = run("skin-driver", "--driver", str(path), "--bus", "virtual:roboskin", "--boards", "7", timeout_s=30)
    told = re.sub(r"(events|thread)\.py, line \d+", r"\1.py, line N", done.stderr)
    assert (told, done.returncode) == (f"skin-driver: {words}\n", 1)


UNWATCHED = """
from skinware_drivers.can.roboskin import RoboskinDriver


class MySkin(RoboskinDriver):
    made = 0

    @classmethod
    def watch(cls, tables):
        cls.made += 1
        if cls.made > 1:
            raise KeyError("oops")
        return super().watch(tables)
"""


@pytest.mark.thorough
def test_a_watch_that_fails_for_a_bus_that_joins_ends_it_too(tmp_path: Path) -> None:
    path, file = tmp_path / "my_skin.py", tmp_path / "torso.toml"
    path.write_text(UNWATCHED)
    first, second = (f'[[bus]]\nname = "virtual:roboskin?boards={board}"\n' for board in (7, 8))
    file.write_text(first)
    with running("skin-driver", "--driver", str(path), "--config", str(file)) as driver:
        driver.wait_for("ready")
        file.write_text(first + second)
        driver.process.send_signal(signal.SIGHUP)
        assert driver.process.wait(60) == 1
        driver.stop()
        assert "`watch` failed: KeyError: 'oops' (my_skin.py, line 12)" in driver.errors
