"""``skin-driver`` and the terminal that it was started in."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from skinware.memory.namespace import Namespace
from tests.commands import BIN, PATIENCE_S


@pytest.mark.thorough
@pytest.mark.parametrize("asked_before", [False, True])
def test_a_driver_ends_with_its_terminal_and_only_then(namespace: Namespace, asked_before: bool) -> None:
    ours, terminal = os.openpty()
    command: list[str | Path] = [
        BIN / "skin-driver",
        "--bus",
        "virtual?boards=7",
        "--namespace",
        namespace.name,
        "--json",
    ]
    try:
        with subprocess.Popen(
            ["setsid", "--ctty", *command], stdin=terminal, stdout=subprocess.PIPE, text=True
        ) as driver:
            try:
                os.close(terminal)
                assert driver.stdout is not None
                assert json.loads(driver.stdout.readline())["event"] == "ready"
                if asked_before:
                    driver.send_signal(signal.SIGHUP)
                    assert [json.loads(driver.stdout.readline())["event"] for _ in range(2)] == ["status"] * 2
                os.close(ours)
                ours = -1
                events = [json.loads(line)["event"] for line in driver.stdout]
                assert events[-1] == "stopped"
                assert driver.wait(PATIENCE_S) == 0
            finally:
                driver.kill()
    finally:
        if ours >= 0:
            os.close(ours)
