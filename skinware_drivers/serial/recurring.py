"""Frames whose length nobody tells: a marker begins each, and the next one follows at once."""

from __future__ import annotations

from dataclasses import dataclass

from skinware_drivers.serial.framing import Framed, Framer, Framing, check_body

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
