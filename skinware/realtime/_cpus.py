"""Lists of CPUs, as people and the kernel write them: ``1,2`` or ``0-3``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from skinware.errors import ConfigurationError

_ITEM = re.compile(r"\s*(\d{1,5})\s*(?:-\s*(\d{1,5})\s*)?", re.ASCII)
_ONLINE = Path("/sys/devices/system/cpu/online")


def cpus_from_text(text: str) -> tuple[int, ...]:
    """CPU numbers from ``1,2`` or ``0-3``, in rising order, each once.

    Raises:
        ConfigurationError: the text is no such list.
    """
    cpus: set[int] = set()
    for item in text.split(","):
        match = _ITEM.fullmatch(item)
        if match is None:
            raise ConfigurationError(f"CPUs {text!r}: give numbers from 0 with commas, as 1,2 or 0-3")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigurationError(f"CPUs {text!r}: the range {item.strip()} does not go upwards")
        cpus.update(range(first, last + 1))
    return tuple(sorted(cpus))


def cpus_as_text(cpus: Iterable[int]) -> str:
    """CPU numbers in rising order with commas."""
    return ",".join(str(cpu) for cpu in sorted(cpus))


def online_cpus() -> tuple[int, ...]:
    """All CPUs that are switched on, also those that nothing runs on unless it asks (``isolcpus``)."""
    try:
        return cpus_from_text(_ONLINE.read_text())
    except OSError:  # a container without /sys
        return tuple(range(os.cpu_count() or 1))
