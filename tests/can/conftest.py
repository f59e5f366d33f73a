"""CAN interfaces for tests are fixtures of the package; here is what else tests of CAN share."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator

import pytest

from skinware_drivers.testing.plugin import ip

NETEM = "netem delay 200s limit 5"


@pytest.fixture
def full_queue() -> Iterator[Callable[[str], None]]:
    """Makes the send queue of an interface hold five frames, each for a long time."""
    made: list[str] = []

    def make(name: str) -> None:
        subprocess.run(["tc", "qdisc", "add", "dev", name, "root", *NETEM.split()], check=True)
        made.append(name)

    yield make
    for name in made:
        subprocess.run(["tc", "qdisc", "del", "dev", name, "root"], capture_output=True)


__all__ = ["full_queue", "ip"]
