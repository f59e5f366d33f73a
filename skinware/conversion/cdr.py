"""ROS 2 messages as bytes: CDR of version 1, little-endian, after the four bytes that say so."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S

_HEADER = b"\x00\x01\x00\x00"


class Cdr:
    """A message that is being written, field by field in the order of its definition."""

    def __init__(self) -> None:
        self._parts: list[bytes] = [_HEADER]
        self._size = 0

    def numbers(self, code: str, *values: float) -> Cdr:
        """Fields of one type.

        Args:
            code: of :mod:`struct`: ``I``, ``q``, ``?`` ...
            values: of the fields.
        """
        self._align(struct.calcsize(f"<{code}"))
        self._append(struct.pack(f"<{len(values)}{code}", *values))
        return self

    def text(self, text: str) -> Cdr:
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._append(data)
        return self

    def texts(self, texts: Sequence[str]) -> Cdr:
        self.numbers("I", len(texts))
        for text in texts:
            self.text(text)
        return self

    def array(self, array: npt.NDArray[np.generic]) -> Cdr:
        """A sequence of numbers; of structures without gaps their bytes."""
        is_bytes = array.dtype.names is not None
        self.numbers("I", array.nbytes if is_bytes else array.size)
        if array.size and not is_bytes:
            self._align(array.dtype.itemsize)
        self._append(np.ascontiguousarray(array).tobytes())
        return self

    def header(self, time_ns: int, frame: str) -> Cdr:
        """A ``std_msgs/Header``.

        Args:
            time_ns: wall clock.
            frame: coordinate frame.
        """
        return self.numbers("i", time_ns // NS_PER_S).numbers("I", time_ns % NS_PER_S).text(frame)

    def done(self) -> bytes:
        return b"".join(self._parts)

    def _align(self, to: int) -> None:
        self._append(bytes(-self._size % to))

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)
