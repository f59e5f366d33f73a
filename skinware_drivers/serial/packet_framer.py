"""Finds packets in a stream: by their beginnings, one by one or all at once."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from skinware_drivers.serial.framing import NOTHING, Framed, Framer
from skinware_drivers.serial.gather import Bytes, Indices
from skinware_drivers.serial.packets import Length, LengthTable, Packet, values_of

_UNKNOWN, _GOOD, _BAD_CHECKSUM, _REFUSED, _INCOMPLETE = range(5)


class PacketFramer(Framer):
    """Finds the frames of a stream by their beginnings."""

    def __init__(self, framing: Packet) -> None:
        super().__init__()
        self._framing = framing
        self._begin = re.compile(_prefixes([values_of(what) for what in framing.sync]), re.DOTALL)
        self._sync = [_table(what) for what in framing.sync]
        self._trailer = [_table(what) for what in framing.trailer]
        self._whole_sync = re.compile(b"".join(_one_of(values_of(what)) for what in framing.sync), re.DOTALL)
        self._whole_trailer = re.compile(b"".join(_one_of(values_of(what)) for what in framing.trailer), re.DOTALL)
        self._known_from = len(framing.sync)  # bytes from which on the length is known
        if isinstance(framing.length, Length):
            self._known_from = max(self._known_from, framing.length.field.end)
        elif isinstance(framing.length, LengthTable):
            self._known_from = max(self._known_from, framing.length.offset + 1)
        self._total_of = np.zeros(256, np.int64)
        if isinstance(framing.length, LengthTable):
            for value, total in framing.length.total.items():
                self._total_of[value] = total
        self._look_ahead = 0
        if framing.confirmed:
            self._look_ahead = framing.longest if framing.trailer else len(framing.sync)
        self._bare = framing.checksum.size if framing.bare_when_empty and framing.checksum else 0
        self._checksum_at = framing.checksum_place(0)  # from the end, if negative
        self._covered_from, self._covered_to = framing.covered(0)  # from the beginning, and from the end
        self._padding = bytes(max(64, 2 * framing.longest))
        self._confirms_each = framing.confirmed == "each"
        self._follows_at = -1  # place in the stream at which a frame would follow the last one at once

    # One by one

    def _find_few(self, stream: bytes) -> tuple[Framed, int]:
        found: list[tuple[int, int, bool]] = []
        done = self._search(stream, 0, found)
        if not found:
            return NOTHING, done
        framing = self._framing
        first, behind, bare = framing.body_start, framing.behind, self._bare
        bodies = [
            stream[place + first : place + total - behind + (bare if is_bare else 0)] for place, total, is_bare in found
        ]
        field = framing.identifier
        identifiers = [0 if field is None else field.of(stream, place) for place, _, _ in found]
        return Framed.of_bodies(bodies, identifiers, [self._before + place + total for place, total, _ in found]), done

    def _search(self, stream: bytes, place: int, found: list[tuple[int, int, bool]]) -> int:
        """Judge what may be a beginning, from ``place`` on, until one cannot be judged yet; gives its place."""
        counters, size = self.counters, len(stream)
        while True:
            match = self._begin.search(stream, place)
            begin = size if match is None else match.start()
            counters.skipped_bytes += begin - place
            place = begin
            if size - place < self._known_from or place == size:
                return place
            total, is_bare = self._total(stream, place)
            follows = not self._look_ahead or (not self._confirms_each and self._before + place == self._follows_at)
            if total:
                if size - place < total:
                    self._wanted = total
                    return place
                form = self._form(stream, place, total, follows)
                if form == _INCOMPLETE:
                    self._wanted = total + self._look_ahead
                    return place
                if form == _GOOD:
                    if is_bare or self._has_checksum(stream, place, total):
                        counters.frame_bytes += total
                        found.append((place, total, is_bare))
                        place += total
                        self._follows_at = self._before + place
                        continue
                    counters.checksum_errors += 1
                else:
                    counters.refused += 1
            else:
                counters.refused += 1
            counters.skipped_bytes += 1
            place += 1

    def _total(self, stream: bytes, place: int) -> tuple[int, bool]:
        """Bytes of the frame that begins here, 0 if it cannot be; and whether it has no checksum."""
        framing = self._framing
        if isinstance(framing.length, int):
            return framing.length, False
        if isinstance(framing.length, LengthTable):
            total, is_bare = int(self._total_of[stream[place + framing.length.offset]]), False
        else:
            says = framing.length.field.of(stream, place)
            is_bare = says == 0 and self._bare > 0
            total = says + framing.length.more - (self._bare if is_bare else 0)
        return (total if framing.shortest <= total <= framing.longest else 0), is_bare

    def _form(self, stream: bytes, place: int, total: int, follows: bool) -> int:
        """Whether the frame ends as it should and, if it must, is followed by another."""
        n = len(self._trailer)
        if n and not self._whole_trailer.match(stream, place + total - n):
            return _REFUSED
        if follows:
            return _GOOD
        if len(stream) - place < total + self._look_ahead:
            return _INCOMPLETE
        if not self._whole_sync.match(stream, place + total):
            return _REFUSED
        return _GOOD if not n or self._whole_trailer.match(stream, place + 2 * total - n) else _REFUSED

    def _has_checksum(self, stream: bytes, place: int, total: int) -> bool:
        checksum = self._framing.checksum
        if checksum is None:
            return True
        end = place + total
        at = (end if self._checksum_at < 0 else place) + self._checksum_at
        covered = stream[place + self._covered_from : end + self._covered_to]
        return checksum.of(covered) == int.from_bytes(stream[at : at + checksum.size], checksum.order)

    # All at once

    def _find_many(self, stream: bytes) -> tuple[Framed, int]:
        data = np.frombuffer(b"".join((self._padding, stream, self._padding)), np.uint8)
        begin, stop = len(self._padding), len(self._padding) + len(stream)
        at = self._beginnings(data, begin, stop - self._known_from + 1)
        total, is_bare = self._totals(data, at)
        state = np.full(len(at), _GOOD if self._framing.checksum is None else _UNKNOWN, np.uint8)
        state[is_bare] = _GOOD
        state[~_match(data, at + total - len(self._trailer), self._trailer)] = _REFUSED
        state[at + total > stop] = _INCOMPLETE
        state[total == 0] = _REFUSED
        taken, place = self._choose(data, at, total, state, begin, stop)
        at, total, is_bare = at[taken], total[taken], is_bare[taken]
        in_frames = int(total.sum())
        self.counters.frame_bytes += in_frames
        self.counters.skipped_bytes += place - begin - in_frames
        # No beginning whose length is known is left, except for one that is not whole.
        done = self._search(stream, place - begin, [])
        field, first = self._framing.identifier, self._framing.body_start
        identifier = at * 0 if field is None else field.of_many(data, at)
        length = total - (first + self._framing.behind) + is_bare * self._bare
        return Framed(data, at + first, length, identifier, at + total + (self._before - begin)), done

    def _beginnings(self, data: Bytes, begin: int, limit: int) -> Indices:
        """Where the first bytes are right and the length is known, ascending."""
        if limit <= begin:
            return np.zeros(0, np.int64)
        if not self._sync:
            return np.arange(begin, limit)
        values = values_of(self._framing.sync[0])
        part = data[begin:limit]
        at = np.flatnonzero(part == values[0] if len(values) == 1 else self._sync[0][part]) + begin
        for offset, table in enumerate(self._sync[1:], 1):
            at = at[table[data[at + offset]]]
        return at

    def _totals(self, data: Bytes, at: Indices) -> tuple[Indices, npt.NDArray[np.bool_]]:
        framing = self._framing
        is_bare = np.zeros(len(at), bool)
        if isinstance(framing.length, int):
            return np.full(len(at), framing.length), is_bare
        if isinstance(framing.length, LengthTable):
            total = self._total_of[data[at + framing.length.offset]]
        else:
            says = framing.length.field.of_many(data, at)
            if self._bare:
                is_bare = says == 0
            total = says + framing.length.more - is_bare * self._bare
        total[(total < framing.shortest) | (total > framing.longest)] = 0
        return total, is_bare

    def _choose(
        self, data: Bytes, at: Indices, total: Indices, state: npt.NDArray[np.uint8], begin: int, stop: int
    ) -> tuple[list[int], int]:
        """Which of the beginnings are those of frames, and the place up to which that is known.

        Checksums are worked out for chains of beginnings, each where the frame before it ends: all frames of a
        healthy stream at once.
        """
        follower = np.searchsorted(at, at + total).tolist()
        states, place_of = state.data, at.tolist()
        is_followed = self._are_followed(data, at, total, stop)
        follows_at = -1 if self._confirms_each else self._follows_at - self._before + begin
        taken: list[int] = []
        number, end = 0, begin
        while number < len(place_of):
            verdict = states[number]
            if verdict == _UNKNOWN:
                chain, link = [], number
                while link < len(place_of) and states[link] == _UNKNOWN:
                    chain.append(link)
                    link = follower[link]
                self._judge(data, at, total, state, np.array(chain))
                continue
            if verdict == _INCOMPLETE:
                return taken, max(end, place_of[number])
            if is_followed is not None and verdict != _REFUSED and place_of[number] != follows_at:
                if is_followed[number] == _INCOMPLETE:
                    return taken, max(end, place_of[number])
                if is_followed[number] == _REFUSED:
                    verdict = _REFUSED
            if verdict == _GOOD:
                taken.append(number)
                end = place_of[number] + int(total[number])
                follows_at = -1 if self._confirms_each else end
                number = follower[number]
                self._follows_at = self._before + end - begin
                continue
            if verdict == _REFUSED:
                self.counters.refused += 1
            else:
                self.counters.checksum_errors += 1
            end = place_of[number] + 1
            number += 1
        return taken, end

    def _are_followed(self, data: Bytes, at: Indices, total: Indices, stop: int) -> list[int] | None:
        """For frames that must be confirmed: whether each is, or cannot be told yet."""
        if not self._look_ahead:
            return None
        following = at + total
        right = _match(data, following, self._sync)
        right &= _match(data, following + total - len(self._trailer), self._trailer)
        verdict = np.where(right, _GOOD, _REFUSED)
        verdict[following + self._look_ahead > stop] = _INCOMPLETE
        of_each: list[int] = verdict.tolist()
        return of_each

    def _judge(self, data: Bytes, at: Indices, total: Indices, state: npt.NDArray[np.uint8], some: Indices) -> None:
        """Work out the checksums of some beginnings."""
        checksum = self._framing.checksum
        if checksum is None:
            return
        begin, size = at[some], total[some]
        sent_at = begin + self._checksum_at + (size if self._checksum_at < 0 else 0)
        right = checksum.read_many(data, sent_at) == checksum.of_many(
            data, begin + self._covered_from, begin + size + self._covered_to
        )
        state[some] = np.where(right, _GOOD, _BAD_CHECKSUM)


def _match(data: Bytes, at: Indices, tables: Sequence[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
    """(n,) bool: whether the bytes from each place on are what a pattern says; False behind the end of the buffer."""
    right = np.ones(len(at), bool)
    for offset, table in enumerate(tables):
        right &= table[data.take(at + offset, mode="clip")]
    return right


def _table(what: int | Collection[int]) -> npt.NDArray[np.bool_]:
    table = np.zeros(256, bool)
    table[values_of(what)] = True
    return table


def _one_of(values: Sequence[int]) -> bytes:
    return b"[" + b"".join(re.escape(bytes([value])) for value in values) + b"]"


def _prefixes(pattern: Sequence[Sequence[int]]) -> bytes:
    """Regular expression of the pattern, or of its beginning at the end of the stream."""
    if not pattern:
        return b""
    rest = _prefixes(pattern[1:])
    return _one_of(pattern[0]) + (b"(?:\\Z|" + rest + b")" if rest else b"")


__all__ = ["PacketFramer"]
