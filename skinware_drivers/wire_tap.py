"""Keep frames and bytes that go over a wire, while a program records them, until they are fetched. C adds some, too."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from skinware.wire import BATCH_BYTES, BYTES, CLASSIC, FD, IS_CUT, IS_FD, MOST_BYTES, MOST_FRAMES, PIECE, ROWS, size_of

_ROOM = 1 << 20
"""Bytes that can wait to be fetched."""
_CLASSIC_PAYLOAD, _FD_PAYLOAD = 8, 64
_PLACES = np.arange(_FD_PAYLOAD)
_SIZE = PIECE.fields["size"][1] if PIECE.fields is not None else 0


class Kept(ctypes.Structure):
    """``struct tap`` of C: the memory, and the number of frames or bytes for which it had no room."""

    _fields_ = [
        ("bytes", ctypes.c_void_p),
        ("room", ctypes.c_int64),
        ("size", ctypes.c_int64),
        ("missed", ctypes.c_int64),
    ]


class WireTap:
    """Keeps the frames and bytes of one wire as pieces (:mod:`skinware.wire`); at first it is closed and keeps none."""

    def __init__(self) -> None:
        self._kept = Kept()
        self._memory: npt.NDArray[np.uint8] | None = None

    @property
    def is_open(self) -> bool:
        return self._memory is not None

    @property
    def address(self) -> int:
        """Address of the ``struct tap``, for C; 0 while closed."""
        return 0 if self._memory is None else ctypes.addressof(self._kept)

    @property
    def missed(self) -> int:
        """Frames or bytes that had no room since it was opened."""
        return int(self._kept.missed)

    def open(self) -> None:
        if self._memory is None:
            self._memory = np.zeros(_ROOM, np.uint8)
            self._kept = Kept(self._memory.ctypes.data, _ROOM, 0, 0)

    def close(self) -> None:
        """Discard all pieces, and keep no more. Idempotent."""
        self._memory = None
        self._kept = Kept()

    def fetch(self) -> Iterator[memoryview]:
        """Yield the pieces in batches of at most ``BATCH_BYTES``, and discard them: copy each batch at once."""
        if self._memory is None:
            return
        data, begin, end = self._memory[: self._kept.size].data, 0, 0
        while end < len(data):
            size = int.from_bytes(data[end + _SIZE : end + _SIZE + 4], "little")
            if end + size - begin > BATCH_BYTES:
                yield data[begin:end]
                begin = end
            end += size
        if end > begin:
            yield data[begin:end]
        self._kept.size = 0

    def keep_rows(self, wire: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]) -> None:
        """Keep frames of a batch, unless its frames can be longer than those of CAN.

        Args:
            wire: (n,) of :func:`skinware_drivers.bus.wire_dtype`.
            time_ns: (n,) int64.
        """
        known = wire.dtype["payload"].shape[0]
        if known > _FD_PAYLOAD:
            return
        form = CLASSIC if known == _CLASSIC_PAYLOAD else FD
        for begin in range(0, len(wire), MOST_FRAMES):
            some = slice(begin, begin + MOST_FRAMES)
            count = len(wire[some])
            into = self._begin(form, count, False)
            if into is None:
                continue
            into[: 8 * count].view("<i8")[:] = time_ns[some]
            rows = into[8 * count :].view(ROWS[form])
            for name in ("identifier", "length", "flags"):
                rows[name] = wire[name][some]
            rows["payload"][:, :known] = wire["payload"][some]
            rows["flags"][rows["length"] > known] |= IS_CUT
            rows["length"] = np.minimum(rows["length"], known)
            # behind a short frame there are bytes of earlier frames
            rows["payload"][_PLACES[: rows["payload"].shape[1]] >= rows["length"][:, np.newaxis]] = 0
            rows["reserved"] = 0

    def keep_frame(
        self, time_ns: int, identifier: int, payload: bytes, *, flags: int = 0, is_sent: bool = False
    ) -> None:
        """Keep one frame, unless it is longer than those of CAN.

        Args:
            time_ns: when it was received or sent.
            identifier: with the flags of linux/can.h.
            flags: of CAN FD; more than 8 bytes are always FD.
            is_sent: whether the driver sent it.
        """
        form = CLASSIC if len(payload) <= _CLASSIC_PAYLOAD else FD
        into = self._begin(form, 1, is_sent) if len(payload) <= _FD_PAYLOAD else None
        if into is not None:
            into[:8].view("<i8")[0] = time_ns
            rows = into[8:].view(ROWS[form])
            padded = payload.ljust(_CLASSIC_PAYLOAD if form == CLASSIC else _FD_PAYLOAD, b"\0")
            flags = flags | IS_FD if form == FD else flags
            rows[0] = (identifier, len(payload), flags, 0, np.frombuffer(padded, np.uint8))

    def keep_bytes(self, time_ns: int, data: bytes, *, is_sent: bool = False) -> None:
        """Keep bytes of a serial line that were read or written together."""
        for begin in range(0, len(data), MOST_BYTES):
            some = data[begin : begin + MOST_BYTES]
            into = self._begin(BYTES, len(some), is_sent)
            if into is not None:
                into[:8].view("<i8")[0] = time_ns
                into[8:] = np.frombuffer(some.ljust(len(into) - 8, b"\0"), np.uint8)

    def _begin(self, form: int, count: int, is_sent: bool) -> npt.NDArray[np.uint8] | None:
        """Begin a piece, and return the place of its times and contents; None: closed, or no room."""
        if self._memory is None:
            return None
        kept, size = self._kept, size_of(form, count)
        begin = int(kept.size)
        if begin + size > kept.room:
            kept.missed += count
            return None
        kept.size = begin + size
        head = self._memory[begin : begin + PIECE.itemsize].view(PIECE)
        head[0] = (size, count, form, is_sent, np.zeros(6, np.uint8))
        return self._memory[begin + PIECE.itemsize : begin + size]
