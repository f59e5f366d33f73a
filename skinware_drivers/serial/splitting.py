"""Frames that become several: one message about all modules of a device, or one with messages of other wires in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from skinware_drivers.serial.framing import Framed, Framer, Framing

Splitting = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
"""(identifier, body) of a frame -> those of the frames that it becomes."""


class Part(NamedTuple):
    """Bytes of a body that become a frame.

    Attributes:
        identifier: of that frame.
        start: first byte in the body.
        stop: one past the last.
    """

    identifier: int
    start: int
    stop: int


@dataclass(frozen=True)
class Split(Framing):
    """Frames of another framing, each split into several; they have the time and the end of the whole.

    Attributes:
        whole: how frames lie in the stream, and how commands are sent.
        splitting: what becomes of one; must not raise, whatever it is given.
    """

    whole: Framing
    splitting: Splitting
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", self.whole.maximum_body)

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return _Splitter(self.whole.framer(), self.splitting)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A command, as a whole frame.

        Raises:
            ValueError: there is no such frame.
        """
        return self.whole.encode(identifier, payload)


def by_length(known: Mapping[tuple[int, int], Sequence[Part]]) -> Splitting:
    """Split frames of some identifiers and lengths of body; others stay as they are."""

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        parts = known.get((identifier, len(body)))
        if parts is None:
            return [(identifier, body)]
        return [(part.identifier, body[part.start : part.stop]) for part in parts]

    return split


class _Splitter(Framer):
    def __init__(self, whole: Framer, splitting: Splitting) -> None:
        super().__init__()
        self._whole, self._splitting = whole, splitting

    @property
    def position(self) -> int:
        return self._whole.position

    @property
    def pending(self) -> int:
        return self._whole.pending

    @property
    def is_lost(self) -> bool:
        return self._whole.is_lost

    def asked(self) -> None:
        self._whole.asked()

    def feed(self, chunk: bytes) -> list[Framed]:
        """Find whole frames, and split them; the counters are of whole ones."""
        self._whole.counters = self.counters
        split = self._splitting
        return [
            Framed(identifier, body, frame.end)
            for frame in self._whole.feed(chunk)
            for identifier, body in split(frame.identifier, frame.body)
        ]

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        raise NotImplementedError  # the framer of the whole frames finds
