"""Take the newest sample of several rings in one call of C."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Generic

from skinware import native
from skinware.memory import futex
from skinware.memory.ring import SampleT
from skinware.memory.ring_reader import FramePool, RingReader

_newest_at_once = native.core().quick.skinware_native_newest
_newest = native.core().waiting.skinware_native_newest
_NEWS, _NO_NEWS = 1, 0  # what look.c returns


class PythonsTurn(Exception):
    """Something else than samples is to be done, which Python does."""


class _SeenRing(ctypes.Structure):
    """``seen_ring`` of look.c."""

    _fields_ = [("turns", ctypes.c_void_p), ("start", ctypes.c_uint64)]


class _LookState(ctypes.Structure):
    """``skinware_native_look`` of look.c."""

    _fields_ = [
        ("count", ctypes.c_uint64),
        ("news_only", ctypes.c_uint64),
        ("until_ns", ctypes.c_int64),
        ("asked_ns", ctypes.c_int64),
        ("rings", _SeenRing * futex.MAX_WORDS),
        ("words", (ctypes.c_uint64 * 3) * futex.MAX_WORDS),
    ]


class Look(Generic[SampleT]):
    """A look at several rings whose readers have left their turns to C.

    Args:
        rings: 1 to :data:`skinware.memory.futex.MAX_WORDS`.
    """

    def __init__(self, rings: Sequence[RingReader[SampleT]]) -> None:
        self.rings = rings
        self._state = _LookState(len(rings))
        self._state_at = ctypes.byref(self._state)
        self._pool = FramePool(rings)
        for seen, ring, start in zip(self._state.rings, rings, self._pool.starts, strict=False):
            seen.turns, seen.start = ctypes.addressof(ring.turns), start

    def newest(self, until_ns: int | None) -> tuple[SampleT, ...] | None:
        """The newest frame of every ring, each a private copy.

        Args:
            until_ns: wait for another frame than those of the last look, at most until then (CLOCK_MONOTONIC ns), and
                maybe not as long. None: take what is there.

        Returns:
            None if there is nothing new.

        Raises:
            PythonsTurn: nothing was taken, and the readers have to look.
        """
        frames, _, memory = self._pool.free()
        for frame in frames:
            frame.stale = False
        state = self._state
        state.news_only, state.until_ns = until_ns is not None, 0
        result = _newest_at_once(
            self._state_at, memory
        )  # which keeps the interpreter lock: others may have it for long
        if result == _NO_NEWS:
            state.until_ns = until_ns
            result = _newest(self._state_at, memory)
        if result == _NEWS:
            return frames
        if result == _NO_NEWS:
            return None
        raise PythonsTurn


def look_at(rings: Sequence[RingReader[SampleT]]) -> Look[SampleT] | None:
    """Return a look at some rings; None where there are none, or too many for one system call."""
    return Look(rings) if 1 <= len(rings) <= futex.MAX_WORDS else None
