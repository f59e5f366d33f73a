"""Both ends of a ring with their data path in C, where it was compiled; they do what those in Python do.

A reader's frame is made before it sleeps. One call then sleeps and copies into it without the interpreter lock, so that
nothing is left to do when the lock is there again: after a sleep the processor's caches are cold, and whatever Python
does then costs several times what it costs in a loop.
"""

from __future__ import annotations

import ctypes
import time
from typing import Any

from skinware import native
from skinware.memory.ring import FrameT, RingReader
from skinware.memory.ring_writer import RingWriter
from skinware.memory.segments import Segment

_COPIED, _NOTHING = 1, 0  # what library.c answers
_WAKE_COUNT, _KNOWN, _WANTED, _TIMEOUT_NS = range(4, 8)  # words of its skinware_native_request, after those of the ring


def ring_reader(segment: Segment, frame_class: type[FrameT], context: object = None) -> RingReader[FrameT]:
    """A reader's end of a generation, native where that is possible."""
    library = native.core()
    if library is None:
        return RingReader(segment, frame_class, context)
    return NativeRingReader(segment, frame_class, context, library)


def ring_writer(segment: Segment) -> RingWriter:
    """The writer's end of a generation, native where that is possible."""
    library = native.core()
    return RingWriter(segment) if library is None else NativeRingWriter(segment, library)


class NativeRingReader(RingReader[FrameT]):
    """A reader's end whose waits and copies are calls of C."""

    def __init__(self, segment: Segment, frame_class: type[FrameT], context: object, library: native.Library) -> None:
        super().__init__(segment, frame_class, context)
        self._copy_call = library.quick.skinware_native_copy
        self._wait_call = library.waiting.skinware_native_wait
        self._request = (ctypes.c_uint64 * 8)(*_ring_words(segment))
        self._request_at = ctypes.byref(self._request)
        self._bytes = ctypes.c_char * segment.layout.slot_stride
        self._spare: tuple[FrameT, ctypes.Array[ctypes.c_char]] | None = None

    def wait(self, wake_count: int, latest: int, timeout_ns: int, sequence: int | None = None) -> FrameT | None:
        """As in Python."""
        frame, memory = self._next()
        request = self._request
        request[_WAKE_COUNT] = wake_count
        request[_KNOWN] = latest
        request[_WANTED] = sequence or 0
        request[_TIMEOUT_NS] = timeout_ns
        return self._copied(self._wait_call(self._request_at, memory), frame)

    def copy(self, sequence: int | None = None) -> FrameT | None:
        """As in Python."""
        frame, memory = self._next()
        return self._copied(self._copy_call(self._request_at, ctypes.c_uint64(sequence or 0), memory), frame)

    def _next(self) -> tuple[FrameT, ctypes.Array[ctypes.c_char]]:
        """The frame to fill next, and its memory."""
        if self._spare is None:
            data = bytearray(self.segment.layout.slot_stride)
            self._spare = self._frame_class(self, data), self._bytes.from_buffer(data)
        return self._spare

    def _copied(self, result: int, frame: FrameT) -> FrameT | None:
        if result == _COPIED:
            self._spare = None
            return frame
        if result == _NOTHING:
            return None
        raise self._overrun()


class _WriterState(ctypes.Structure):
    """``skinware_ring_writer`` of ring.h."""

    _fields_ = [
        ("map", ctypes.c_void_p),
        ("slot_offset", ctypes.c_uint64),
        ("slot_stride", ctypes.c_uint64),
        ("slot_count", ctypes.c_uint64),
        ("begun_ns", ctypes.c_int64),
        ("cpu_ns", ctypes.c_int64),
    ]


class NativeRingWriter(RingWriter):
    """The writer's end whose publication is a call of C."""

    def __init__(self, segment: Segment, library: native.Library) -> None:
        super().__init__(segment)
        self._begin_call = library.quick.skinware_native_begin
        self._commit_call = library.quick.skinware_native_commit
        self._commit_call.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_uint64
        self._commit_call.restype = ctypes.c_uint64
        self._wake_call = library.quick.skinware_native_wake
        self._state = _WriterState(*_ring_words(segment), 0, time.thread_time_ns())
        self._state_at = ctypes.byref(self._state)
        self.native_address = ctypes.addressof(self._state)

    def wake(self) -> None:
        """As in Python."""
        self._wake_call(self._state_at)

    def _take_next(self) -> None:
        self._begin_call(self._state_at)

    def _has_begun(self) -> bool:
        return bool(self._state.begun_ns)

    def _publish(self, acquired_ns: int, flags: int) -> int:
        return int(self._commit_call(self._state_at, acquired_ns, flags))


def _ring_words(segment: Segment) -> tuple[Any, ...]:
    """``skinware__ring`` of skinware.h."""
    layout = segment.layout
    return segment.data.ctypes.data, layout.slot_offset, layout.slot_stride, layout.slot_count
