"""``skin-driver`` with a driver whose code has a fault: one line, exit status 1, never a process that does nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.commands import run

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
