"""Turns of the interpreter's threads while a driver runs beside others in its process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

TURN_S = 1e-4
_before_s: list[float] = []


@contextmanager
def short_turns() -> Iterator[None]:
    """Let no thread keep the interpreter for longer than ``TURN_S`` when another wants it; Python's default is 5 ms.

    A driver lets go of the interpreter dozens of times for a batch (numpy does, for arrays of some length, and so do
    system calls), and beside a thread that computes it would wait for a turn each time: too long for the receive
    buffer of a fast bus (docs/benchmarks.md). It holds for the whole process, until the last driver in it has ended.
    """
    _before_s.append(sys.getswitchinterval())
    sys.setswitchinterval(min(TURN_S, _before_s[-1]))
    try:
        yield
    finally:
        sys.setswitchinterval(_before_s.pop())
