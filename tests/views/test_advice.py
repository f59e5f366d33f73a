"""The page asks skin-doctor for advice while drivers have problems, and only then."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Coroutine

import pytest

from skinware.views import programs
from skinware.views.programs import DoctorProgram
from skinware_drivers.testing.waiting import wait_until

SAYS = "import json, sys; print(json.dumps({'findings': [{'what': 'silent', 'asked': sys.argv[1:]}]}))"


def run(ask: Coroutine[None, None, None]) -> None:
    """Run a test, and wait for the threads in which asyncio waited for processes."""
    asyncio.run(ask)
    wait_until(lambda: not any("waitpid" in thread.name for thread in threading.enumerate()))


async def until_done(doctor: DoctorProgram) -> None:
    assert doctor._running is not None
    await asyncio.wait({doctor._running})


def test_it_is_asked_while_problems_last(monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask() -> None:
        doctor = DoctorProgram((sys.executable, "-c", SAYS), "lab")
        doctor.follow([])
        assert doctor._running is None
        doctor.follow(["stale"])
        await until_done(doctor)
        (finding,) = doctor.findings
        assert finding["asked"][-2:] == ["--namespace", "lab"]
        doctor.findings = []
        doctor.follow(["stale", "dead"])  # too soon
        assert doctor._running is None
        monkeypatch.setattr(programs, "_SOON_NS", 0)
        doctor.follow(["stale", "dead"])
        await until_done(doctor)
        assert doctor.findings
        doctor.follow([])
        assert doctor.findings == []
        await doctor.close()

    run(ask())


@pytest.mark.parametrize("program", [("-c", "raise SystemExit(2)"), ("-c", "print('{')"), ("-c", "print('[]')")])
def test_one_that_fails_advises_nothing(program: tuple[str, ...]) -> None:
    async def ask() -> None:
        doctor = DoctorProgram((sys.executable, *program), "lab")
        doctor.follow(["stale"])
        await until_done(doctor)
        assert doctor.findings == []

    run(ask())


def test_it_ends_with_the_server() -> None:
    async def ask() -> None:
        doctor = DoctorProgram((sys.executable, "-c", "import time; time.sleep(600)"), "lab")
        doctor.follow(["stale"])
        await asyncio.sleep(0)
        await doctor.close()
        assert doctor._running is None

    run(ask())
