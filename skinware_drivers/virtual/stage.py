"""What all emulated hardware on a bus does alike: it keeps devices in order of time on one wire.

See :class:`skinware_drivers.virtual.hardware.EmulatedHardware` for what a carrier may ask of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.virtual import events
from skinware_drivers.virtual.hardware import EventLog, WireFrame
from skinware_drivers.virtual.wire import Wire

_IDENTIFIER_MASK = 0x1FFF_FFFF
_MOST_LISTED = 40
_LONGEST_CATCH_UP_NS = 1_000_000_000
"""What ``skip`` still emulates frame by frame; the time before it is jumped over."""


class Actor(Protocol):
    """A device on the wire that does things by itself."""

    def next_event_ns(self) -> int | None:
        """When ``run`` has something to do."""

    def run(self, now_ns: int) -> None:
        """Do what is due: queue frames on the wire."""

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; returns how many frames that would have been."""


class _Scheduled(NamedTuple):
    time_ns: int
    action: Callable[[int], object]


class Stage(ABC):
    """Emulated devices on one bus, powered up by the first call that tells a time.

    Args:
        log: takes the :mod:`.events`; a list will do.
        counted: names of the totals beside ``frames`` given by ``emit``, ``bursts`` of a device, ``commands`` that some
            device obeyed or answered, ``silenced`` frames, and ``unheard`` frames of ``skip``.

    Attributes:
        wire: what the devices share.
        log: where events go.
        counts: the totals.
        silent: kinds of frames that the devices do not send; see :meth:`kind_of`.
    """

    def __init__(self, log: EventLog | None, counted: Sequence[str]) -> None:
        self.wire: Wire = Wire()
        self.log: EventLog = _Unlogged() if log is None else log
        self.counts: dict[str, int] = dict.fromkeys(
            ("frames", "bursts", "commands", *counted, "silenced", "unheard"), 0
        )
        self.silent: set[str] = set()
        self._actors: list[Actor] = []
        self._scheduled: list[_Scheduled] = []
        self._now_ns: int | None = None
        self._event_ns: int | None = None

    @abstractmethod
    def power_up(self, now_ns: int) -> Sequence[Actor]:
        """Make the devices."""

    @abstractmethod
    def hear(self, identifier: int, payload: bytes, now_ns: int) -> list[int]:
        """Let the devices hear a frame of the host; returns the addresses of those that obeyed or answered it."""

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name the kind of a frame that a device sends, as the option ``silence`` does; by default its identifier."""
        return f"0x{identifier & _IDENTIFIER_MASK:03x}"

    # EmulatedHardware

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take one frame from the bus. Frames that mean nothing to the devices are ignored."""
        now_ns = self.run_to(now_ns)
        obeyed = self.hear(identifier, payload, now_ns)
        self.find_next_event()
        if obeyed:
            self.counts["commands"] += 1
            self.log.append(
                events.CommandReceived(time_ns=now_ns, identifier=identifier, payload=payload.hex(), boards=obeyed)
            )

    def next_due_ns(self) -> int | None:
        """When ``emit`` is worth calling again; None while all devices are silent."""
        if self.wire.heard:
            return self.wire.heard[0].time_ns
        event_ns, start_ns = self._event_ns, self.wire.next_start_ns()
        if event_ns is None or start_ns is None:
            return start_ns if event_ns is None else event_ns
        return min(event_ns, start_ns)

    def emit(self, now_ns: int) -> list[WireFrame]:
        """The frames that began by ``now_ns`` and were not given before, oldest first."""
        self.run_to(now_ns)
        frames, self.wire.heard = self.wire.heard, []
        if self.silent:
            spoken = [frame for frame in frames if self.kind_of(frame.identifier, frame.payload) not in self.silent]
            self.counts["silenced"] += len(frames) - len(spoken)
            frames = spoken
        self.counts["frames"] += len(frames)
        return frames

    def skip(self, now_ns: int) -> int:
        """Let the devices run on with nobody listening; returns the number of frames that went unheard."""
        unheard = 0
        if self._now_ns is not None and now_ns - self._now_ns > _LONGEST_CATCH_UP_NS:
            self.wire.run(now_ns - _LONGEST_CATCH_UP_NS)
            unheard += sum(actor.skip_to(now_ns - _LONGEST_CATCH_UP_NS) for actor in self._actors)
            self.find_next_event()
        self.run_to(now_ns)
        unheard += len(self.wire.heard)
        self.wire.heard = []
        self.counts["unheard"] += unheard
        return unheard

    def totals(self) -> dict[str, int]:
        """Exact counts since power-up."""
        return dict(self.counts)

    # For those who make devices

    def plan_silence(self, kinds: Collection[str], known: Collection[str], after_s: float, now_ns: int) -> None:
        """Stop frames of these kinds, at a time from now.

        Raises:
            ConfigurationError: the devices send no frames of such a kind.
        """
        for kind in kinds:
            if kind not in known:
                raise ConfigurationError(f"option silence: {kind!r} is no kind of frame; there are {_shortened(known)}")
        self.schedule(now_ns + round(after_s * 1e9), lambda _: self.silent.update(kinds))

    def run_to(self, now_ns: int) -> int:
        """Bring everything to ``now_ns``, in order of time; returns the time that holds."""
        if self._now_ns is None:
            self._now_ns = now_ns
            self._actors = list(self.power_up(now_ns))
            self.find_next_event()
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        while True:
            event_ns = self._event_ns
            if event_ns is None or event_ns > now_ns:
                self.wire.run(now_ns + 1)
                return now_ns
            self.wire.run(event_ns)
            while self._scheduled and self._scheduled[0].time_ns <= event_ns:
                self._scheduled.pop(0).action(event_ns)
            for actor in self._actors:
                actor.run(event_ns)
            self.find_next_event()

    def find_next_event(self) -> None:
        """To be called whenever a device may have changed its mind about when it has something to do."""
        times_ns = [time_ns for actor in self._actors if (time_ns := actor.next_event_ns()) is not None]
        if self._scheduled:
            times_ns.append(self._scheduled[0].time_ns)
        self._event_ns = min(times_ns, default=None)

    def schedule(self, time_ns: int, action: Callable[[int], object]) -> None:
        self._scheduled.append(_Scheduled(time_ns, action))
        self._scheduled.sort(key=lambda scheduled: scheduled.time_ns)


def _shortened(names: Collection[str]) -> str:
    listed = list(names)
    return ", ".join(listed if len(listed) <= _MOST_LISTED else [*listed[:_MOST_LISTED], "..."])


class _Unlogged:
    """The log of those who want none."""

    def append(self, event: msgspec.Struct) -> None:
        """Forget the event."""
