"""CAN interfaces for tests: a fresh vcan each, and the lab's pair of emulated controllers."""

from __future__ import annotations

import itertools
import os
import subprocess
from collections.abc import Callable, Iterator

import pytest

_numbers = itertools.count()


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def vcan() -> Iterator[Callable[[], str]]:
    """Makes vcan interfaces of unique names, up; they are deleted at the end."""
    made: list[str] = []

    def make() -> str:
        name = f"vc{os.getpid() % 10000}x{next(_numbers)}"
        ip("link", "add", "dev", name, "type", "vcan")
        made.append(name)
        ip("link", "set", name, "up")
        return name

    yield make
    for name in made:
        subprocess.run(["ip", "link", "del", name], capture_output=True)


@pytest.fixture
def can_pair() -> Iterator[tuple[str, str]]:
    """Two CAN controllers on one wire, at 1 Mbit/s and up: can0 and can1 of the lab."""
    if os.environ.get("SKINWARE_CAN_LAB") != "1":
        pytest.skip("two CAN controllers on one wire are only known to be there in the CAN lab")
    pair = ("can0", "can1")
    for name in pair:
        ip("link", "set", name, "type", "can", "bitrate", "1000000")
        ip("link", "set", name, "up")
    yield pair
    for name in pair:
        ip("link", "set", name, "down")
