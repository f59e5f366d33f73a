"""Turns of the interpreter's threads beside one that must not wait for long."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

TURN_S = 1e-4
_before_s: list[float] = []


@contextmanager
def short_turns() -> Iterator[None]:
    """Let no thread keep the interpreter for longer than ``TURN_S`` when another wants it; Python's default is 5 ms.

    Beside a thread that computes, whoever lets go of the interpreter waits that long for it: a reader after each sleep,
    a driver dozens of times for a batch (numpy lets go for arrays of some length, and so do system calls). That is too
    long for a ring of 8 slots at 1 kHz, or the receive buffer of a fast bus (docs/benchmarks.md). It holds for the
    whole process, until the last one has ended.
    """
    _before_s.append(sys.getswitchinterval())
    sys.setswitchinterval(min(TURN_S, _before_s[-1]))
    try:
        yield
    finally:
        sys.setswitchinterval(_before_s.pop())
