"""CAN adapters that python-can finds through the libraries of their makers.

Those libraries may hang or crash, so they are asked in a process of its own, which is ended when its time is over.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Any

_NOT_ASKED = ("socketcan", "serial", "virtual", "udp_multicast", "socketcand")
"""Looked at otherwise, no adapters, or (socketcand) waits four seconds for who may announce himself in the network."""


@dataclass(frozen=True)
class CanAdapterFound:
    """A channel of an adapter.

    Attributes:
        bus: its name for ``--bus``: ``kvaser:0``.
        details: what else the library told.
    """

    bus: str
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Detection:
    """What python-can found.

    Attributes:
        found: adapters.
        problem: what went wrong, empty if nothing did.
    """

    found: list[CanAdapterFound] = field(default_factory=list)
    problem: str = ""


def detect_adapters(timeout_s: float, command: list[str] | None = None) -> Detection:
    """Ask all interfaces of python-can that can tell.

    Args:
        timeout_s: longest time for all of them.
        command: the process to start, for tests.
    """
    process = subprocess.Popen(
        command or [sys.executable, "-m", __name__],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    in_time = True
    try:
        output, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        in_time = False
        process.kill()
        output, _ = process.communicate()
    found, asked, is_over = _read(output)
    if is_over:
        return Detection(found)
    how = f"did not answer within {timeout_s:g} s" if not in_time else "ended the search"
    return Detection(found, f"python-can's interface {asked!r} {how}" if asked else f"python-can {how}")


def _read(output: str) -> tuple[list[CanAdapterFound], str, bool]:
    """Adapters, the interface that was asked last, and whether all were asked. Libraries may print what they like."""
    found: list[CanAdapterFound] = []
    asked = ""
    for line in output.splitlines():
        try:
            told = json.loads(line)
            asked, configs = told["asked"], told["configs"]
        except (ValueError, TypeError, KeyError):
            continue
        if asked is None:
            return found, "", True
        for config in configs:
            interface, channel = config.pop("interface", asked), config.pop("channel", "")
            found.append(CanAdapterFound(f"{interface}:{channel}", config))
    return found, asked, False


def _tell(asked: str | None, configs: list[dict[str, Any]]) -> None:
    sys.stdout.write(json.dumps({"asked": asked, "configs": configs}, default=str) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Ask one interface after the other; tell which is asked before and what it found afterwards."""
    import can

    for name in sorted(set(can.VALID_INTERFACES) - set(_NOT_ASKED)):
        _tell(name, [])
        _tell(name, [dict(config) for config in can.detect_available_configs(interfaces=[name])])
    _tell(None, [])
    os._exit(0)  # whatever threads and exit handlers the libraries have


if __name__ == "__main__":
    main()
