"""Frames that begin with their length and have no other mark, of devices that only answer (over TCP, usually).

Nothing in such a stream says where a frame begins, but the end of the one before, and that nothing comes unasked. What
is no answer puts it out of step, and whatever would be found after that would be found by chance: values of one finger
would be shown as those of another. So nothing more is found until the next question, with whose answer it is in step
again; and if it is not, three questions in a row, the bus is lost, and opened again: a new connection begins in step.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from skinware.errors import ConfigurationError
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, check_body

_MOST_IN_VAIN = 3


@dataclass(frozen=True, kw_only=True)
class LengthFirst(Framing):
    """Frames of a length field, a command, and a body.

    Attributes:
        length: bytes of the whole frame.
        identifier: command.
        answers: command and bytes of the whole frame of every answer that there can be.

    Raises:
        ConfigurationError: an answer is shorter than its header.
    """

    length: Field
    identifier: Field
    answers: Collection[tuple[int, int]] = field(hash=False)
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        for command, total in self.answers:
            if total < self.header:
                raise ConfigurationError(f"an answer to {command:#04x} cannot have {total} bytes")
        totals = [total for _, total in self.answers]
        object.__setattr__(self, "maximum_body", max(totals, default=self.header) - self.header)

    @property
    def header(self) -> int:
        """Bytes before the body."""
        return max(self.length.end, self.identifier.end)

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return _Steps(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A question, which need not be as long as an answer.

        Raises:
            ValueError: there is no such frame.
        """
        check_body(identifier, payload, self.identifier, 0, (1 << 8 * self.length.size) - 1 - self.header)
        frame = bytearray(self.header)
        self.length.put(frame, self.header + len(payload))
        self.identifier.put(frame, identifier)
        return bytes(frame) + payload


class _Steps(Framer):
    """Goes from length to length."""

    def __init__(self, framing: LengthFirst) -> None:
        super().__init__()
        self._framing = framing
        self._is_in_step = True
        self._vain = 0  # questions in a row whose answers put it out of step

    @property
    def is_lost(self) -> bool:
        return self._vain >= _MOST_IN_VAIN

    def asked(self) -> None:
        """Half an answer to an earlier question is never completed by one to this."""
        if self._rest:
            self._stumble(len(self._rest))
            self._before += len(self._rest)
            self._rest, self._wanted = b"", 0
        if not self._is_in_step:
            self._vain += 1
            self._is_in_step = not self.is_lost

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        framing, header, place = self._framing, self._framing.header, 0
        while self._is_in_step and len(stream) - place >= header:
            total, command = framing.length.of(stream, place), framing.identifier.of(stream, place)
            if (command, total) not in framing.answers:
                self._stumble(0)
            elif len(stream) - place < total:
                self._wanted = total
                break
            else:
                found.append(Framed(command, stream[place + header : place + total], self._before + place + total))
                self.counters.frame_bytes += total
                place += total
                self._vain = 0
        if not self._is_in_step:
            self.counters.skipped_bytes += len(stream) - place
            place = len(stream)
        return found, place

    def _stumble(self, skipped: int) -> None:
        self._is_in_step = False
        self.counters.refused += 1
        self.counters.skipped_bytes += skipped
