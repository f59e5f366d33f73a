"""Find frames that begin with their length, recur after a marker, or are matrices of text; and split frames."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from skinware.errors import ConfigurationError
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, Splitting, begun, check_body

_MOST_IN_VAIN = 3


@dataclass(frozen=True, kw_only=True)
class LengthFirst(Framing):
    """Frames of a length field, a command, and a body, from a device that only answers.

    Attributes:
        length: bytes of the whole frame.
        identifier: command.
        answers: command and bytes of the whole frame of every possible answer.

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
        return _Steps(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return a question, which need not be as long as an answer."""
        check_body(identifier, payload, self.identifier, 0, (1 << 8 * self.length.size) - 1 - self.header)
        frame = bytearray(self.header)
        self.length.put(frame, self.header + len(payload))
        self.identifier.put(frame, identifier)
        return bytes(frame) + payload


class _Steps(Framer):
    """Steps from length to length; out of step, it skips everything until the next question."""

    def __init__(self, framing: LengthFirst) -> None:
        super().__init__()
        self._framing = framing
        self._is_in_step = True
        self._vain = 0  # questions in a row whose answers put it out of step

    def asked(self) -> None:
        """Drop half an answer to an earlier question: no answer to this one completes it."""
        if self._rest:
            self._stumble(len(self._rest))
            self._before += len(self._rest)
            self._rest, self._wanted = b"", 0
        if not self._is_in_step:
            self._vain += 1
            self.is_lost = self._vain >= _MOST_IN_VAIN
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


_TIMES = 3
"""Further markers that must follow at the same distance: bytes of a body can look like a marker, too."""


@dataclass(frozen=True)
class Recurring(Framing):
    """Frames of one unknown length: the distance at which the marker recurs.

    A driver listens with this framing until it knows the length of the frames, and then changes to a
    :class:`~skinware_drivers.serial.packets.Packet` of that length (``SerialAdapter.change_framing``).

    Attributes:
        marker: first bytes of every frame.
        maximum_body: bytes of the longest possible body.
        minimum_body: bytes of the shortest.
        identifier: of all frames that are found, so that no layout takes them for frames of the known length.
    """

    marker: bytes
    maximum_body: int
    minimum_body: int = 1
    identifier: int = 1

    def framer(self) -> Framer:
        return _RecurringFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        check_body(identifier - self.identifier, payload, None, self.minimum_body, self.maximum_body)
        return self.marker + payload


class _RecurringFramer(Framer):
    def __init__(self, framing: Recurring) -> None:
        super().__init__()
        self._framing = framing
        self._least = len(framing.marker) + framing.minimum_body
        self._most = len(framing.marker) + framing.maximum_body

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        marker, found, place = self._framing.marker, list[Framed](), 0
        while (begin := stream.find(marker, place)) >= 0:
            self.counters.skipped_bytes += begin - place
            place = begin
            distance = self._distance(stream, place)
            if distance is None:
                return found, place
            if distance:
                body = stream[place + len(marker) : place + distance]
                found.append(Framed(self._framing.identifier, body, self._before + place + distance))
                self.counters.frame_bytes += distance
            else:
                self.counters.refused += 1
                self.counters.skipped_bytes += 1
            place += distance or 1
        kept = begun(stream[place:], marker)
        self.counters.skipped_bytes += len(stream) - kept - place
        return found, len(stream) - kept

    def _distance(self, stream: bytes, place: int) -> int | None:
        """Return the distance of this marker from the next of a row; 0: no such row, None: more bytes must come."""
        marker, other = self._framing.marker, place + self._least - 1
        while True:
            other = stream.find(marker, other + 1)
            distance = other - place
            if other < 0 or distance > self._most:
                may_come = other < 0 and len(stream) - place < self._most + len(marker)
                return None if may_come else 0
            for at in range(place + 2 * distance, place + _TIMES * distance + 1, distance):
                if len(stream) < at + len(marker):
                    return None
                if not stream.startswith(marker, at):
                    break
            else:
                return distance


_ROW = re.compile(rb"[0-9]{1,3}(?: +[0-9]{1,3})* *\r?")
_EMPTY = (b"", b"\r")
_LONGEST_NUMBER = 4  # with the space behind it
_LONGEST_END = 2


@dataclass(frozen=True)
class TextMatrix(Framing):
    """A line for each row, with decimal numbers from 0 to 255, and an empty line behind the last row.

    The body of a frame has two bytes for the numbers of rows and columns, and then the numbers, row by row. Matrices
    whose rows differ in length are skipped; so are bytes before the first empty line, which may be the end of a matrix.

    Attributes:
        rows: most rows, up to 255.
        columns: most columns, up to 255.
        identifier: of all frames that are found.
    """

    rows: int
    columns: int
    identifier: int = 0
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", 2 + self.rows * self.columns)

    def framer(self) -> Framer:
        return _TextMatrixFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return the lines of a matrix."""
        check_body(identifier - self.identifier, payload, None, 3, self.maximum_body)
        rows, columns, *numbers = payload
        if len(numbers) != rows * columns or not self.is_possible(rows, columns):
            raise ValueError(f"a payload that says {rows} x {columns} and has {len(numbers)} numbers")
        lines = (numbers[row * columns :][:columns] for row in range(rows))
        return b"".join(b" ".join(b"%d" % number for number in line) + b"\n" for line in lines) + b"\n"

    def is_possible(self, rows: int, columns: int) -> bool:
        """Return whether a matrix can have this size."""
        return 0 < rows <= self.rows and 0 < columns <= self.columns


class _TextMatrixFramer(Framer):
    def __init__(self, framing: TextMatrix) -> None:
        super().__init__()
        self._framing = framing
        self._longest = framing.rows * (framing.columns * _LONGEST_NUMBER + _LONGEST_END)
        self._discarding = True  # everything up to the next empty line

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        begin = line = 0
        while (end := stream.find(b"\n", line)) >= 0:
            if stream[line:end] in _EMPTY:
                self._take(stream[begin:line], end + 1 - begin, self._before + end + 1, found)
                begin = end + 1
            line = end + 1
        if not self._discarding and len(stream) - begin > self._longest + _LONGEST_END:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            kept = max(line, len(stream) - 2)  # distinguishes an empty line from the end of another
            self.counters.skipped_bytes += kept - begin
            begin = kept
        return found, begin

    def _take(self, text: bytes, size: int, end: int, found: list[Framed]) -> None:
        """Judge the text before an empty line; ``size`` counts that line."""
        if self._discarding:
            self._discarding = False
        elif not text:
            self.counters.idle_bytes += size
            return
        elif (body := self._body(text)) is not None:
            self.counters.frame_bytes += size
            found.append(Framed(self._framing.identifier, body, end))
            return
        else:
            self.counters.refused += 1
        self.counters.skipped_bytes += size

    def _body(self, text: bytes) -> bytes | None:
        lines = text.split(b"\n")[:-1] if len(text) <= self._longest else []
        if not all(_ROW.fullmatch(line) for line in lines):
            return None
        numbers = [[int(number) for number in line.split()] for line in lines]
        columns = {len(row) for row in numbers}
        if len(columns) != 1 or not self._framing.is_possible(len(numbers), *columns):
            return None
        if max(map(max, numbers)) > 0xFF:
            return None
        return bytes((len(numbers), *columns, *(number for row in numbers for number in row)))


class Part(NamedTuple):
    """A part of a body that becomes a frame.

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
    """Frames of another framing that is not split, each split into several with the time and the end of the whole.

    Attributes:
        whole: how frames lie in the stream, and how commands are sent.
        splitting: returns the parts of a frame; must not raise, whatever it is given.
    """

    whole: Framing
    splitting: Splitting
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", self.whole.maximum_body)

    def framer(self) -> Framer:
        framer = self.whole.framer()
        framer.splitting = self.splitting
        return framer

    def encode(self, identifier: int, payload: bytes) -> bytes:
        return self.whole.encode(identifier, payload)


def by_length(known: Mapping[tuple[int, int], Sequence[Part]]) -> Splitting:
    """Return a splitting of frames of known identifiers and lengths of body; others stay whole."""

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        parts = known.get((identifier, len(body)))
        if parts is None:
            return [(identifier, body)]
        return [(part.identifier, body[part.start : part.stop]) for part in parts]

    return split
