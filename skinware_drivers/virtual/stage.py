"""Emulated devices on one wire: their time, power and commands, and the faults of the frames that they send."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import msgspec
import numpy as np

from skinware.errors import ConfigurationError
from skinware_drivers.bus import EXTENDED_FLAG, check_identifier
from skinware_drivers.options import HasOptions
from skinware_drivers.virtual.device import DATA, Device, EmulatorOptions, ForeignTraffic, Transmission, Wire
from skinware_drivers.virtual.hardware import Event, EventLog, FrameDamage, WireFrame
from skinware_drivers.virtual.physics import WORLD_NS, open_world

if TYPE_CHECKING:  # needs MuJoCo
    from skinware_drivers.virtual.physics.world import PhysicsWorld

OptionsT = TypeVar("OptionsT", bound=EmulatorOptions)

_FAULTS: dict[str, FrameDamage] = {
    "lose": "lost",
    "truncate": "truncated",
    "corrupt": "corrupted",
    "repeat": "repeated",
}
"""The damage that each option with a probability does to data frames."""
_MOST_LISTED = 40
_REPLY_NS = 200_000
_LONGEST_CATCH_UP_NS = 1_000_000_000
"""Time that ``skip`` still emulates frame by frame; earlier time is jumped over."""


class Stage(ABC, HasOptions[OptionsT]):
    """Emulated devices on one bus, powered up by the first call that has a time.

    Attributes:
        Options: class of the options; they become those of ``skin-emulate`` and of ``--bus virtual?...``.
        numbered_by: name of the option that has these numbers, or the one number; empty: no option has them.
        counted: names of the totals besides ``frames`` of ``emit``, ``bursts`` of devices, ``commands`` that a device
            obeyed or answered, ``silenced`` frames, and ``unheard`` frames of ``skip``.
        longest_queue: frames that a device keeps for the wire; more are lost.
        silent: kinds of frames that the devices do not send; see :meth:`kind_of`.
        world: the physics that presses the devices; None: they feel the option ``pattern``.
    """

    medium: ClassVar[str] = "can"
    Options: ClassVar[type[msgspec.Struct]] = EmulatorOptions
    least_options: ClassVar[type[msgspec.Struct]] = EmulatorOptions
    options_command = "skin-emulate"
    reserved_options = frozenset(("bus", "driver", "geometry", "help", "json", "log", "name", "namespace", "version"))
    numbers: Sequence[int] = (0,)
    numbered_by: ClassVar[str] = ""
    counted: ClassVar[Sequence[str]] = ("lost", "repeated", "truncated", "corrupted", "foreign")
    longest_queue: ClassVar[int] = 256

    def __init__(self, options: OptionsT, *, log: EventLog | None = None) -> None:
        HasOptions.__init__(self, options)
        if self.numbered_by:
            numbers = getattr(options, self.numbered_by)
            self.numbers = numbers if isinstance(numbers, tuple) else (numbers,)
        self.wire: Wire = Wire()
        self.log: EventLog = deque(maxlen=0) if log is None else log
        counted = ("frames", "bursts", "commands", *self.counted, "silenced", "unheard")
        self.counts: dict[str, int] = dict.fromkeys(counted, 0)
        self.silent: set[str] = set()
        self.devices: dict[int, Device] = {}
        self.world: PhysicsWorld | None = open_world(options, type(self))
        self._foreign: ForeignTraffic | None = None
        self._scheduled: list[tuple[int, Callable[[int], object]]] = []
        self._now_ns: int | None = None
        self._event_ns: int | None = None
        for name in ("dead", "restart"):
            for number in getattr(options, name):
                if number not in self.numbers:
                    known = ",".join(map(str, self.numbers))
                    raise ConfigurationError(f"option {name}: there is no device {number}; there are {known}")

    # A subclass defines these

    @abstractmethod
    def boot(self, device: Device, now_ns: int) -> None:
        """Begin what a device does once it has power."""

    @abstractmethod
    def on_timer(self, device: Device, name: str, time_ns: int) -> None:
        """Do what a device does by itself when one of its timers is due."""

    @abstractmethod
    def kinds(self) -> Sequence[str]:
        """Name the kinds of frames with data that the devices send, for the option ``silence``."""

    @abstractmethod
    def foreign_identifiers(self, random: np.random.Generator) -> Sequence[int]:
        """Return the identifiers of other devices on the bus, for the option ``foreign_hz``."""

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Take a command; return whether the device obeyed or answered. By default it knows none."""
        return False

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name the kind of a frame that a device sends, as the option ``silence`` does; by default its identifier."""
        return f"0x{identifier & ~EXTENDED_FLAG:03x}"

    def make_device(self, number: int, now_ns: int) -> Device:
        return Device(number, self.wire.attach(), now_ns, self.options.seed)

    # A subclass may use these

    def reply(self, device: Device, frame: tuple[int, bytes], now_ns: int) -> None:
        """Send one frame besides the data."""
        if self.medium == "can":
            check_identifier(frame[0])
        device.queue.append(Transmission(now_ns + _REPLY_NS, [frame[0]], [frame[1]]))

    def send_burst(
        self,
        device: Device,
        identifiers: Sequence[int],
        payloads: Sequence[bytes],
        time_ns: int,
        *,
        usual: bool = False,
    ) -> None:
        """Hand the frames of a burst to the wire; faults happen here.

        Args:
            time_ns: when they are ready, unless the option ``jitter_us`` delays them.
            usual: all have 8 bytes and 11-bit identifiers.
        """
        ready_ns = time_ns
        if self.options.jitter_us:
            ready_ns += int(device.random.integers(0, self.options.jitter_us, endpoint=True)) * 1000
        if ready_ns > time_ns:
            late = Event("burst_delayed", time_ns, board=device.number, cycle=device.cycle, delay_ns=ready_ns - time_ns)
            self.log.append(late)
        chances = [getattr(self.options, name) for name in _FAULTS]
        lost: set[int] = set()
        if any(chances) or sum(map(len, device.queue)) + len(identifiers) > self.longest_queue:
            identifiers, payloads, lost = self._with_faults(device, identifiers, payloads, time_ns, chances)
            usual = usual and all(len(payload) == 8 for payload in payloads)
        if identifiers:
            device.queue.append(Transmission(ready_ns, identifiers, payloads, lost, usual=usual, cycle=device.cycle))
        device.cycle += 1
        self.counts["bursts"] += 1

    def lose_power_for_a_moment(self, device: Device, now_ns: int) -> None:
        """Restart a device, as a command may do."""
        self._lose_power(device, now_ns, "restarted")
        ready_ns = now_ns + round(self.options.boot_s * 1e9)
        self.log.append(Event("board_restarted", now_ns, board=device.number, ready_ns=ready_ns))
        device.alive, device.ready_ns = True, ready_ns

        def boot(time_ns: int) -> None:
            if device.alive and device.ready_ns == ready_ns:  # else it lost its power again
                self.boot(device, time_ns)

        self.schedule(ready_ns, boot)

    def schedule(self, time_ns: int, action: Callable[[int], object]) -> None:
        """Call ``action`` with the time when it has come."""
        self._scheduled.append((time_ns, action))
        self._scheduled.sort(key=itemgetter(0))

    def run_to(self, now_ns: int) -> int:
        """Bring everything to ``now_ns``, in order of time; return the time that holds, which never goes back."""
        if self._now_ns is None:
            self._now_ns = now_ns
            self.power_up(now_ns)
            self.find_next_event()
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        while True:
            event_ns = self._event_ns
            if event_ns is None or event_ns > now_ns:
                self.wire.run(now_ns + 1)
                return now_ns
            self.wire.run(event_ns)
            while self._scheduled and self._scheduled[0][0] <= event_ns:
                self._scheduled.pop(0)[1](event_ns)
            for device in self.devices.values():
                for name, time_ns in device.due(event_ns):
                    self.on_timer(device, name, time_ns)
            if self._foreign is not None:
                self._foreign.run(event_ns)
            self.find_next_event()

    def find_next_event(self) -> None:
        """Look up the next event again, after a device may have changed its timers."""
        times_ns = [time_ns for one in self.devices.values() if (time_ns := one.next_event_ns()) is not None]
        if self._foreign is not None:
            times_ns.append(self._foreign.next_event_ns)
        if self._scheduled:
            times_ns.append(self._scheduled[0][0])
        self._event_ns = min(times_ns, default=None)

    # Faults at a moment of the caller's choice

    def kill(self, number: int, now_ns: int) -> None:
        """Make a device fall silent and deaf for good; frames that wait for the wire are lost."""
        now_ns = self.run_to(now_ns)
        self.die(self.device(number), now_ns)
        self.find_next_event()

    def restart(self, number: int, now_ns: int) -> None:
        """Cut a device's power for a moment (a dead one lives again): it forgets its settings, and is deaf a while."""
        now_ns = self.run_to(now_ns)
        self.lose_power_for_a_moment(self.device(number), now_ns)
        self.find_next_event()

    # EmulatedHardware, the contract with the bus that carries the frames

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take one frame from the bus. Frames that mean nothing to the devices are ignored."""
        now_ns = self.run_to(now_ns)
        obeyed = [
            number
            for number, device in [(device.number, device) for device in self.devices.values()]
            if device.alive and now_ns >= device.ready_ns and self.obey(device, identifier, payload, now_ns)
        ]
        self.find_next_event()
        if obeyed:
            self.counts["commands"] += 1
            command = payload.hex()
            self.log.append(Event("command_received", now_ns, identifier=identifier, payload=command, boards=obeyed))

    def next_due_ns(self) -> int | None:
        """Return when ``emit`` is worth calling again; None while all devices are silent."""
        if self.wire.heard:
            return self.wire.heard[0].time_ns
        times_ns = (self._event_ns, self.wire.next_start_ns())
        return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)

    def emit(self, now_ns: int) -> list[WireFrame]:
        """Return the frames that began by ``now_ns`` and were not returned before, oldest first."""
        self.run_to(now_ns)
        frames, self.wire.heard = self.wire.heard, []
        if self.silent:
            spoken = [frame for frame in frames if self.kind_of(frame.identifier, frame.payload) not in self.silent]
            self.counts["silenced"] += len(frames) - len(spoken)
            frames = spoken
        self.counts["frames"] += len(frames)
        return frames

    def skip(self, now_ns: int) -> int:
        """Let the devices run on without a listener; return the number of frames that went unheard."""
        unheard = 0
        if self._now_ns is not None and now_ns - self._now_ns > _LONGEST_CATCH_UP_NS:
            until_ns = now_ns - _LONGEST_CATCH_UP_NS
            self.wire.run(until_ns)
            for device in self.devices.values():
                unheard += sum(self.skipped(device, name, times) for name, times in device.skip_to(until_ns))
            if self._foreign is not None:
                unheard += self._foreign.skip_to(until_ns)
            self.find_next_event()
        self.run_to(now_ns)
        unheard += len(self.wire.heard)
        self.wire.heard = []
        self.counts["unheard"] += unheard
        return unheard

    def close(self) -> None:
        """Take away what a world publishes until the devices run on. Idempotent."""
        if self.world is not None:
            self.world.close()

    def totals(self) -> dict[str, int]:
        """Return exact counts since power-up."""
        return dict(self.counts)

    # Within

    def power_up(self, now_ns: int) -> None:
        """Make the devices and everything else on the bus."""
        options = self.options
        for number in self.numbers:
            self.devices[number] = self.make_device(number, now_ns)
        self._run_world(now_ns)
        for device in self.devices.values():
            self.boot(device, now_ns)
        for number in options.dead:
            self.schedule(now_ns + round(options.dead_after_s * 1e9), partial(self.die, self.devices[number]))
        for number in options.restart:
            restart = partial(self.lose_power_for_a_moment, self.devices[number])
            self.schedule(now_ns + round(options.restart_after_s * 1e9), restart)
        known = self.kinds() if options.silence else ()
        for kind in options.silence:
            if kind not in known:
                listed = ", ".join([*known[:_MOST_LISTED], *(["..."] if len(known) > _MOST_LISTED else [])])
                raise ConfigurationError(f"option silence: {kind!r} is no kind of frame; there are {listed}")
        self.schedule(now_ns + round(options.silence_after_s * 1e9), lambda _: self.silent.update(options.silence))
        if options.foreign_hz:
            random = np.random.default_rng([options.seed, 2])
            others, queue = self.foreign_identifiers(random), self.wire.attach()
            self._foreign = ForeignTraffic(others, options.foreign_hz, random, queue, self.log, self.counts, now_ns)

    def _run_world(self, time_ns: int) -> None:
        """Let the physics run on, and look at its commands, where no device has felt it lately; again and again."""
        if self.world is not None and self._now_ns is not None:
            if time_ns >= self.world.advanced_ns + WORLD_NS:
                self.world.advance(time_ns)
            again_ns = max(self.world.advanced_ns + WORLD_NS, self._now_ns - _LONGEST_CATCH_UP_NS)
            self.schedule(again_ns, self._run_world)

    def device(self, number: int) -> Device:
        for device in self.devices.values():
            if device.number == number:
                return device
        known = ",".join(str(device.number) for device in self.devices.values())
        raise ConfigurationError(f"there is no emulated device {number}; there are {known}")

    def die(self, device: Device, now_ns: int) -> None:
        self._lose_power(device, now_ns, "died")
        self.log.append(Event("board_died", now_ns, board=device.number))

    def skipped(self, device: Device, name: str, times: int) -> int:
        """Count what a timer would have done ``times``; return how many frames that would have been."""
        if name == DATA:
            device.cycle += times
            self.counts["bursts"] += times
        return times

    def part_of(self, identifier: int, payload: bytes, position: int) -> Mapping[str, Any]:  # noqa: ARG002
        """Return what a data frame of a burst is about, as fields of an event; by default nothing."""
        return {}

    def _note_fault(self, fault: Event, payload: bytes) -> None:
        self.counts["lost" if fault.fault == "unsent" else str(fault.fault)] += 1
        part = self.part_of(fault.identifier, payload, fault.position)
        self.log.append(msgspec.structs.replace(fault, **part))

    def _with_faults(
        self,
        device: Device,
        identifiers: Sequence[int],
        payloads: Sequence[bytes],
        time_ns: int,
        chances: Sequence[float],
    ) -> tuple[list[int], list[bytes], set[int]]:
        """Return the frames that go to the wire, and the positions of those that take their time there and are lost."""
        faults = list(_FAULTS.values())
        hit = device.random.random((len(identifiers), len(faults))) < chances
        damage = partial(Event, "frame_fault", time_ns, board=device.number, cycle=device.cycle)
        sent_as: list[int] = []
        sent: list[bytes] = []
        lost: set[int] = set()
        for position, (identifier, whole) in enumerate(zip(identifiers, payloads, strict=True)):
            fault: FrameDamage | None = faults[int(hit[position].argmax())] if hit[position].any() else None
            if sum(map(len, device.queue)) + len(sent_as) >= self.longest_queue:
                fault = "unsent"
            payload = whole
            if fault is not None:
                if fault == "truncated":
                    payload = whole[: int(device.random.integers(0, max(1, len(whole))))]
                elif fault == "corrupted":
                    payload = device.random.bytes(len(whole))
                reason = {"unsent": "overflow", "lost": "random"}.get(fault)
                what: dict[str, Any] = {"fault": fault, "reason": reason, "payload": payload.hex()}
                self._note_fault(damage(position=position, identifier=identifier, **what), whole)
            if fault == "lost":
                lost.add(len(sent_as))
            times = {"unsent": 0, "repeated": 2}.get(fault or "", 1)
            sent_as += [identifier] * times
            sent += [payload] * times
        return sent_as, sent, lost

    def _lose_power(self, device: Device, now_ns: int, reason: str) -> None:
        device.alive = False
        for burst in device.queue:
            lost = partial(Event, "frame_fault", now_ns, board=device.number, cycle=burst.cycle, fault="unsent")
            for at in range(burst.sent, len(burst.identifiers)):
                if burst.cycle >= 0 and at not in burst.lost:
                    identifier, payload = burst.identifiers[at], burst.payloads[at]
                    event = lost(position=at, identifier=identifier, payload=payload.hex(), reason=reason)
                    self._note_fault(event, payload)
        device.queue.clear()
        device.clear()
