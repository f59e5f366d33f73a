"""The specification of the search for frames in the bytes of a line: what ``framing.c`` does, one by one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

from skinware_drivers.serial.delimited import Cobs, Delimited, Escaped, Stuffing
from skinware_drivers.serial.framing import Framed, Framer, Framing
from skinware_drivers.serial.packets import Length, LengthTable, Packet
from skinware_drivers.serial.stream import values_of

_GOOD, _REFUSED, _INCOMPLETE = range(3)
_MISSES, _MARKS, _SIGHTINGS, _PATIENCE = 4, 3, 2, 16
"""A step is kept if one of so many marks is in place; beginnings that compete are compared by how many of so many marks
follow; from so many frames in a row on, a false mark is known; lengths after which a lost step is forgotten."""


@dataclass(frozen=True)
class InPython(Framing):
    """A framing whose frames are found as it is specified here."""

    declared: Packet | Delimited

    @property
    def maximum_body(self) -> int:  # type: ignore[override]
        """That of the framing."""
        return self.declared.maximum_body

    def framer(self) -> Framer:
        """The framer of the specification."""
        return PacketFramer(self.declared) if isinstance(self.declared, Packet) else DelimitedFramer(self.declared)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """As the framing does."""
        return self.declared.encode(identifier, payload)


class PacketFramer(Framer):
    """Finds the frames of a stream by their beginnings."""

    def __init__(self, framing: Packet) -> None:
        super().__init__()
        self._framing = framing
        self._begin = re.compile(_prefixes([values_of(what) for what in framing.sync]), re.DOTALL)
        self._whole_sync = re.compile(b"".join(_one_of(values_of(what)) for what in framing.sync), re.DOTALL)
        self._whole_trailer = re.compile(b"".join(_one_of(values_of(what)) for what in framing.trailer), re.DOTALL)
        self._known_from, self._look_ahead = framing.known_from, framing.look_ahead
        self._bare = framing.checksum.size if framing.bare_when_empty and framing.checksum else 0
        self._checksum_at = framing.checksum_place(0)  # from the end, if negative
        self._covered_from, self._covered_to = framing.covered(0)  # from the beginning, and from the end
        self._follows_at = -1  # place in the stream of the next frame in step
        self._seen: dict[int, int] = {}  # false marks: at each offset, in how many frames in a row

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[tuple[int, int, bool]] = []
        done = (self._search_marked if self._look_ahead else self._search)(stream, 0, found)
        framing, field = self._framing, self._framing.identifier
        first, behind, bare = framing.body_start, framing.behind, self._bare
        return [
            Framed(
                0 if field is None else field.of(stream, place),
                stream[place + first : place + total - behind + (bare if is_bare else 0)],
                self._before + place + total,
            )
            for place, total, is_bare in found
        ], done

    def _search(self, stream: bytes, place: int, found: list[tuple[int, int, bool]]) -> int:
        """Judge possible beginnings from ``place`` on; return the place of the first that needs more bytes."""
        counters, size = self.counters, len(stream)
        while True:
            match = self._begin.search(stream, place)
            begin = size if match is None else match.start()
            counters.skipped_bytes += begin - place
            place = begin
            if size - place < self._known_from or place == size:
                return place
            total, is_bare = self._total(stream, place)
            if total:
                if size - place < total:
                    self._wanted = total
                    return place
                if self._ends(stream, place + total):
                    if is_bare or self._has_checksum(stream, place, total):
                        counters.frame_bytes += total
                        found.append((place, total, is_bare))
                        place += total
                        continue
                    counters.checksum_errors += 1
                else:
                    counters.refused += 1
            else:
                counters.refused += 1
            counters.skipped_bytes += 1
            place += 1

    def _total(self, stream: bytes, place: int) -> tuple[int, bool]:
        """Return the bytes of the frame that begins here, 0 if impossible; and whether it has no checksum."""
        framing = self._framing
        length: int | Length | LengthTable = framing.length
        if isinstance(length, LengthTable):
            length = length.total.get(stream[place + length.offset], 0)
        if isinstance(length, int):
            total, is_bare = length, False
        elif len(stream) - place < length.field.end:  # at least
            return length.field.end, False
        else:
            says = length.field.of(stream, place)
            is_bare = says == 0 and self._bare > 0
            total = says + length.more - (self._bare if is_bare else 0)
        return (total if framing.shortest <= total <= framing.longest else 0), is_bare

    def _search_marked(self, stream: bytes, place: int, found: list[tuple[int, int, bool]]) -> int:
        """Do so for frames of one length without a checksum, of which only the marks between them are known."""
        counters, total = self.counters, self._framing.longest
        while True:
            is_in_step = self._before + place == self._follows_at
            if not is_in_step:
                match = self._begin.search(stream, place)
                begin = len(stream) if match is None else match.start()
                counters.skipped_bytes += begin - place
                place = begin
            if len(stream) - place < total:
                return place
            form, further = self._form(stream, place, is_in_step), 0
            if form == _GOOD:
                form = self._has_slipped(stream, place) if is_in_step else self._competes(stream, place)
            elif form == _REFUSED and is_in_step:
                further = self._next_step(stream, place)
            if form == _INCOMPLETE or further < 0:
                return place
            if form == _GOOD:
                self._seen = {at: self._seen.get(at, 0) + 1 for at in self._false_marks(stream, place)}
                counters.frame_bytes += total
                found.append((place, total, False))
                place += total
                self._follows_at = self._before + place
                continue
            counters.refused += 1
            counters.skipped_bytes += further or 1
            place += further or 1
            if further:
                self._follows_at = self._before + place

    @property
    def _offsets(self) -> range:
        """Offsets in a frame at which a false mark can be."""
        return range(len(self._framing.trailer) or 1, self._framing.longest)

    def _false_marks(self, stream: bytes, place: int) -> set[int]:
        """Return the offsets of marks inside a frame."""
        last = self._framing.longest - (len(self._framing.sync) or 1)
        return {at for at in self._offsets if at <= last and self._is_mark(stream, place + at)}

    @property
    def _known(self) -> list[int]:
        """Offsets of known false marks."""
        return [at for at, frames in self._seen.items() if frames >= _SIGHTINGS]

    def _ends(self, stream: bytes, end: int) -> bool:
        n = len(self._framing.trailer)
        return not n or self._whole_trailer.match(stream, end - n) is not None

    def _is_mark(self, stream: bytes, place: int) -> bool:
        return self._ends(stream, place) and self._whole_sync.match(stream, place) is not None

    def _run(self, stream: bytes, place: int) -> int:
        """Return how many marks follow, frame by frame."""
        steps = range(1, _MARKS + 1)
        return next((n - 1 for n in steps if not self._is_mark(stream, place + n * self._framing.longest)), _MARKS)

    def _form(self, stream: bytes, place: int, is_in_step: bool) -> int:
        """Judge a frame and, if it needs one, the next."""
        total = self._framing.longest
        if not self._whole_sync.match(stream, place) or not self._ends(stream, place + total):
            return _REFUSED
        if is_in_step and self._framing.confirmed != "each":
            return _GOOD
        if len(stream) - place < total + self._look_ahead:
            return _INCOMPLETE
        is_followed = self._is_mark(stream, place + total)
        return _GOOD if is_followed and self._ends(stream, place + 2 * total) else _REFUSED

    def _has_slipped(self, stream: bytes, place: int) -> int:
        """Refuse a frame in step that begins at a false mark: known ones are gone, a true one is as far behind."""
        marks, known = self._false_marks(stream, place), set(self._known)
        is_turned = any(self._framing.longest - at in marks for at in known)
        return _REFUSED if is_turned and not known & marks else _GOOD

    def _next_step(self, stream: bytes, place: int) -> int:
        """Return how far the next frame in step is; 0: the step is lost, -1: more bytes must come."""
        total = self._framing.longest
        if not self._known:
            return 0
        for n in range(2, _MISSES + 1):
            if len(stream) - place < n * total + len(self._framing.sync):
                return -1
            if self._is_mark(stream, place + n * total):
                return total
        for at in self._known:
            if self._run(stream, place + at) == _MARKS:
                self._seen = {}
                return at
        return 0

    def _competes(self, stream: bytes, place: int) -> int:
        """Judge a beginning among all the places that look like one."""
        total = self._framing.longest
        if self._before + place - self._follows_at > _PATIENCE * total:
            self._seen = {} if self._known else self._seen
        known, rivals = self._known, [at for at in self._offsets if self._is_mark(stream, place + at)]
        if not known and not rivals:
            return _GOOD
        if len(stream) - place < (_MARKS + 1) * total + len(self._framing.sync):
            return _INCOMPLETE
        if not set(known) <= set(rivals):
            return _REFUSED
        run = max((self._run(stream, place + at) for at in set(rivals) - set(known)), default=0)
        return _GOOD if run <= self._run(stream, place) else _REFUSED

    def _has_checksum(self, stream: bytes, place: int, total: int) -> bool:
        checksum = self._framing.checksum
        if checksum is None:
            return True
        end = place + total
        at = (end if self._checksum_at < 0 else place) + self._checksum_at
        covered = stream[place + self._covered_from : end + self._covered_to]
        return checksum.of(covered) == int.from_bytes(stream[at : at + checksum.size], checksum.order)


def _one_of(values: Sequence[int]) -> bytes:
    return b"[" + b"".join(re.escape(bytes([value])) for value in values) + b"]"


def _prefixes(pattern: Sequence[Sequence[int]]) -> bytes:
    """Return a regular expression of the pattern, or of its beginning at the end of the stream."""
    if not pattern:
        return b""
    rest = _prefixes(pattern[1:])
    return _one_of(pattern[0]) + (b"(?:\\Z|" + rest + b")" if rest else b"")


class DelimitedFramer(Framer):
    """Finds the frames of a stream with delimiters."""

    def __init__(self, framing: Delimited) -> None:
        super().__init__()
        self._framing = framing
        self._shortest = framing.minimum_body + framing.overhead
        self._longest = framing.maximum_body + framing.overhead
        self._longest_segment = framing.stuffing.longest(self._longest)
        self._delimiter = bytes([framing.stuffing.delimiter])
        self._stuffing = framing.stuffing
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
        kept = len(rest)
        if not self._discarding and kept > self._longest_segment:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            self.counters.skipped_bytes += kept
            kept = 0
        return found, len(stream) - kept

    def _content(self, segment: bytes) -> bytes | None:
        """Return header and body of a segment; None, and counted, if it is no frame."""
        content = _decoded(self._stuffing, segment) if len(segment) <= self._longest_segment else None
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


def _decoded(stuffing: Stuffing, segment: bytes) -> bytes | None:
    """The content between two delimiters; None if it is malformed."""
    if isinstance(stuffing, Cobs):
        return _of_cobs(segment)
    return _unescaped(stuffing, segment) if isinstance(stuffing, Escaped) else segment.removesuffix(b"\r")


def _of_cobs(segment: bytes) -> bytes | None:
    parts, place, size = list[bytes](), 0, len(segment)
    while place < size:
        code = segment[place]
        parts.append(segment[place + 1 : place + code])
        place += code
        if code < 0xFF and place < size:
            parts.append(b"\0")
    return b"".join(parts) if place == size else None


def _unescaped(stuffing: Escaped, segment: bytes) -> bytes | None:
    first, *others = segment.split(bytes([stuffing.escape]))
    parts = [first]
    for part in others:
        if not part or part[0] not in stuffing.meaning:
            return None
        parts += (bytes([stuffing.meaning[part[0]]]), part[1:])
    return b"".join(parts)
