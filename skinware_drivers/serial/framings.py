"""Find frames that end with a delimiter, begin with their length, or recur after a marker."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import accumulate, pairwise

from skinware.errors import ConfigurationError
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, check_body
from skinware_drivers.serial.stuffing import Stuffing


@dataclass(frozen=True)
class Delimited(Framing):
    """Frames that end with a delimiter: header, body and checksum, stuffed.

    The rest of a damaged frame ends at the next delimiter, and the frame after it is found.

    Attributes:
        stuffing: ``LINES``, ``COBS``, ``SLIP`` or ``HDLC``.
        maximum_body: bytes of the longest body. Bodies that are longer are skipped.
        minimum_body: bytes of the shortest. 0: empty lines are frames.
        checksum: of header and body, at the end.
        identifier: number in the header that tells kinds of frame apart.
        header: bytes before the body; default: up to the end of ``identifier``.
        trusts_first: what arrives before the first delimiter is a frame if it looks like one. Default: only with a
            checksum; without one it may as well be the end of a frame.

    Raises:
        ConfigurationError: the identifier is not in the header, or the lengths are impossible.
    """

    stuffing: Stuffing
    maximum_body: int
    minimum_body: int = 1
    checksum: Checksum | None = None
    identifier: Field | None = None
    header: int | None = None
    trusts_first: bool | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.minimum_body <= self.maximum_body:
            raise ConfigurationError(f"bodies of {self.minimum_body} to {self.maximum_body} bytes cannot be")
        if self.identifier is not None and self.identifier.end > self.body_start:
            raise ConfigurationError(f"the identifier is not within the header of {self.body_start} bytes")

    @property
    def body_start(self) -> int:
        """Bytes before the body."""
        if self.header is not None:
            return self.header
        return self.identifier.end if self.identifier is not None else 0

    @property
    def overhead(self) -> int:
        """Bytes of header and checksum."""
        return self.body_start + (self.checksum.size if self.checksum is not None else 0)

    @property
    def is_first_trusted(self) -> bool:
        """Whether what arrives before the first delimiter may be a frame."""
        return self.checksum is not None if self.trusts_first is None else self.trusts_first

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return DelimitedFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A frame as it is sent; the header is zero except for the identifier.

        Raises:
            ValueError: there is no such frame.
        """
        check_body(identifier, payload, self.identifier, self.minimum_body, self.maximum_body)
        header = bytearray(self.body_start)
        if self.identifier is not None:
            self.identifier.put(header, identifier)
        content = bytes(header) + payload
        if self.checksum is not None:
            content += self.checksum.to_bytes(content)
        return self.stuffing.encode(content)


class DelimitedFramer(Framer):
    """Finds the frames of a stream with delimiters."""

    def __init__(self, framing: Delimited) -> None:
        super().__init__()
        self._framing = framing
        self._shortest = framing.minimum_body + framing.overhead
        self._longest = framing.maximum_body + framing.overhead
        self._longest_segment = framing.stuffing.longest(self._longest)
        self._delimiter = bytes([framing.stuffing.delimiter])
        self._decode = framing.stuffing.decode
        self._checksum_size = framing.checksum.size if framing.checksum is not None else 0
        self._discarding = not framing.is_first_trusted  # everything up to the next delimiter

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *segments, rest = stream.split(self._delimiter)
        ends = list(accumulate([len(segment) + 1 for segment in segments], initial=self._before))
        if self._discarding and segments:
            self._discarding = False
            self.counters.skipped_bytes += len(segments[0]) + 1
            del segments[0], ends[0]
        first, field = self._framing.body_start, self._framing.identifier
        found: list[Framed] = []
        for segment, (begin, end) in zip(segments, pairwise(ends), strict=True):
            content = self._content(segment)
            if content is not None:
                self.counters.frame_bytes += end - begin
                found.append(Framed(0 if field is None else field.of(content), content[first:], end))
        return found, len(stream) - self._keep(len(rest))

    def _content(self, segment: bytes) -> bytes | None:
        """Header and body of a segment; None, and counted, if it is no frame."""
        content = self._decode(segment) if len(segment) <= self._longest_segment else None
        if content is not None and self._shortest <= len(content) <= self._longest:
            checksum = self._framing.checksum
            if checksum is None:
                return content
            size = self._checksum_size
            covered = content[:-size]
            if checksum.of(covered) == int.from_bytes(content[-size:], checksum.order):
                return covered
            self.counters.checksum_errors += 1
        elif content == b"":
            self.counters.idle_bytes += len(segment) + 1
            return None
        else:
            self.counters.refused += 1
        self.counters.skipped_bytes += len(segment) + 1
        return None

    def _keep(self, rest: int) -> int:
        """How many of the bytes behind the last delimiter are kept; none of a frame that is too long already."""
        if not self._discarding and rest > self._longest_segment:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            self.counters.skipped_bytes += rest
            return 0
        return rest


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


_TIMES = 3
"""Another marker has to follow so often at the same distance: bytes of a body can look like a marker, too."""


@dataclass(frozen=True)
class Recurring(Framing):
    """Frames of one length, which is not known: it is the distance at which the marker comes again and again.

    For devices that are asked nothing and tell nothing: a driver hears with this framing how long frames are, and goes
    over to a :class:`~skinware_drivers.serial.packets.Packet` of that length (``SerialAdapter.change_framing``).

    Attributes:
        marker: first bytes of every frame.
        maximum_body: bytes of the longest body that can be.
        minimum_body: bytes of the shortest.
        identifier: of all frames that are found, so that no layout takes them for those of a known length.
    """

    marker: bytes
    maximum_body: int
    minimum_body: int = 1
    identifier: int = 1

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return _RecurringFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A frame as it is sent.

        Raises:
            ValueError: there is no such frame.
        """
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
        kept = next(n for n in range(len(marker) - 1, -1, -1) if stream[place:].endswith(marker[:n]))
        self.counters.skipped_bytes += len(stream) - kept - place
        return found, len(stream) - kept

    def _distance(self, stream: bytes, place: int) -> int | None:
        """From this marker to the next one of a row at equal distances; 0: there is no such row, None: nobody knows."""
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
