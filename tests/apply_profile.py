"""Applies a profile to this process and tells as JSON what holds: ``apply_profile.py TEXT CPUS {strict,going-on}``."""

from __future__ import annotations

import gc
import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from skinware.errors import RealtimeRefused
from skinware.realtime import Profile, cpus_from_text
from tests import scheduling
from tests.commands import PATIENCE_S

LATER_KIB = 50_000_000 // 1024
"""What the process asks for once its profile is applied."""


def command(text: str, *, cpus: str = "", strict: bool = False) -> list[str]:
    """The arguments of such a process."""
    return [sys.executable, __file__, text, cpus, "strict" if strict else "going-on"]


def result_of(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """What such a process tells, and its lines on stderr."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=PATIENCE_S, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr.splitlines()


def main() -> None:
    text, cpus, strict = sys.argv[1:]
    logging.basicConfig(format="%(message)s")
    profile = Profile.from_text(text, cpus=cpus_from_text(cpus) if cpus else ())
    told: dict[str, object] = {"error": "", "refused": []}
    try:
        told["refused"] = [str(refusal) for refusal in profile.apply(strict=strict == "strict")]
    except RealtimeRefused as error:
        told["error"] = str(error)
    memory = bytearray(LATER_KIB * 1024)  # memory that is asked for later can still be had, and is locked
    told |= {
        "policy": scheduling.policy(0),
        "cpus": sorted(os.sched_getaffinity(0)),
        "locked_kib": scheduling.locked_kib(os.getpid()),
        "timer_slack_ns": scheduling.timer_slack_ns(os.getpid()),
        "frozen": gc.get_freeze_count(),
        "later_kib": len(memory) // 1024,
    }
    sys.stdout.write(json.dumps(told))


if __name__ == "__main__":
    main()
