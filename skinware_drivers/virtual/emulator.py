"""Emulators of small devices: what a new one need not say.

An emulator says which devices there are, which commands they obey, and which frames they send with which values; see
:class:`Emulator`. What is felt, when frames go out, and what goes wrong with them is decided here, and written down
exactly (:mod:`.events`). Emulators share no code and no table with the drivers that they are there to test.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.bus import EXTENDED_FLAG, check_identifier
from skinware_drivers.options import HasOptions
from skinware_drivers.virtual import events
from skinware_drivers.virtual.emulator_options import EmulatorOptions
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.press import Press
from skinware_drivers.virtual.stage import Actor, Stage
from skinware_drivers.virtual.wire import ForeignTraffic, Transmission, Transmitter

OptionsT = TypeVar("OptionsT", bound=EmulatorOptions)
CanFrame = tuple[int, bytes]
"""Identifier and payload; an identifier of 29 bits has the flag, as in ``EXTENDED_FLAG | 0x18DA00F1``."""
Source = Callable[[int, int], Sequence[int]]
"""(number of the device, number of its burst) -> the values that it sends, whatever is felt."""

_DATA = "data"
_REPLY_NS = 200_000
_FOREIGN_IDENTIFIERS = 40


class Device:
    """One emulated device.

    Attributes:
        number: how the emulator's options name it.
        memory: what commands have set; gone after a restart.
        cycle: bursts sent since the first power-up; the number of the next one.
        ready_ns: when it could hear and send, since it last got power.
        streams_from_ns: when it began to send by itself; None: it does not.
        sampled_ns: when the values of its last burst were felt.
    """

    def __init__(self, number: int, emulator: Emulator[Any], transmitter: Transmitter, now_ns: int) -> None:
        self.number = number
        self.transmitter = transmitter
        self.memory: dict[str, Any] = {}
        self.cycle: int = 0
        self.alive = True
        self.ready_ns = now_ns
        self.streams_from_ns: int | None = None
        self.sampled_ns = now_ns
        self._emulator = emulator
        self._timers: dict[str, tuple[int, int]] = {}  # name -> next, period

    def every(self, name: str, period_ns: int, first_ns: int) -> None:
        """Have ``Emulator.on_timer`` called with ``name``, first at ``first_ns``."""
        self._timers[name] = first_ns, period_ns

    def stop(self, name: str) -> None:
        """End that. Nothing happens if it never began."""
        self._timers.pop(name, None)

    def clear(self) -> None:
        """Forget everything, as without power."""
        self.memory = {}
        self._timers = {}
        self.streams_from_ns = None

    # Actor

    def next_event_ns(self) -> int | None:
        """When ``run`` has something to do."""
        return min((next_ns for next_ns, _ in self._timers.values()), default=None)

    def run(self, now_ns: int) -> None:
        """Do what is due."""
        for name, (next_ns, period_ns) in list(self._timers.items()):
            if next_ns <= now_ns and name in self._timers:
                self._timers[name] = next_ns + period_ns, period_ns
                self._emulator.on_timer(self, name, next_ns)

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; cycles go on. Counts one frame for each."""
        skipped = 0
        for name, (next_ns, period_ns) in self._timers.items():
            times = max(0, -((next_ns - now_ns) // period_ns))
            self._timers[name] = next_ns + times * period_ns, period_ns
            skipped += times
            if name == _DATA:
                self.cycle += times
                self._emulator.counts["bursts"] += times
        return skipped


class Emulator(Stage, HasOptions[OptionsT]):
    """Emulated devices on one bus. Subclasses define the following; faults and time are handled here.

    The brackets name its options: ``class EmulatedThumb(Emulator[EmulatedThumbOptions])``.

    Args:
        options: which devices, what they feel, and what is wrong with them.
        log: receives the :mod:`.events`, for example a list.
        source: the values of every burst, instead of what is felt.

    Attributes:
        medium: kind of bus; for serial lines see :mod:`.serial_device`.
        Options: those options; they become those of ``skin-emulate`` and of ``--bus virtual?...``.
        numbers: of the devices. To be set before ``Emulator.__init__`` where the options say which there are.
        identifiers: all that the devices or their host can use; emulated foreign devices use others.
        period_s: time from burst to burst of a device that sends by itself; an option ``period_ms`` sets it.
        full_scale: greatest value that a device can send. This and the next three: one number, or one for each value.
        lowest: least value that it can send.
        rest: value of a sensor that nobody touches.
        swing: what a firm press adds to it.
        longest_queue: frames that a device keeps for the wire; more are lost.
        devices: by number, once powered up.
    """

    medium: ClassVar[str] = "can"
    Options: ClassVar[type[msgspec.Struct]] = EmulatorOptions
    least_options: ClassVar[type[msgspec.Struct]] = EmulatorOptions
    options_command = "skin-emulate"
    reserved_options = frozenset(("bus", "driver", "geometry", "help", "json", "log", "name", "namespace", "version"))
    numbers: Sequence[int] = (0,)
    identifiers: Collection[int] = ()
    full_scale: int | Sequence[int]
    lowest: int | Sequence[int] = 0
    rest: int | Sequence[int] = 0
    swing: int | Sequence[int]
    longest_queue: ClassVar[int] = 256

    def __init__(self, options: OptionsT, *, log: EventLog | None = None, source: Source | None = None) -> None:
        Stage.__init__(self, log, ("lost", "repeated", "truncated", "corrupted", "foreign"))
        HasOptions.__init__(self, options)
        self._source = source
        self.devices: dict[int, Device] = {}
        self._random: dict[int, np.random.Generator] = {}
        self._press: dict[int, Press] = {}
        self._n_values = 0
        for name in ("dead", "restart", "faulty"):
            for number in getattr(options, name, ()):
                if number not in self.numbers:
                    known = ",".join(map(str, self.numbers))
                    raise ConfigurationError(f"option {name}: there is no device {number}; there are {known}")

    # What a subclass says

    @abstractmethod
    def places(self) -> npt.NDArray[np.float64]:
        """(n, 2) where the n values of a device are felt, 0 to 1; see :func:`.press.on_a_grid`."""

    @abstractmethod
    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """What a device sends in one burst."""

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Take a command; tells whether the device obeyed or answered. By default it knows none."""
        return False

    def boot(self, device: Device, now_ns: int) -> None:
        """What a device does once it has power; by default it streams, if the options want that."""
        if self.options.streaming:
            self.start(device, now_ns)

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        """What the sensors of a device say, at a time since it began to send; by default a finger wanders over them.

        The options ``pattern=idle`` and ``pattern=cycle`` come before this.
        """
        felt = np.rint(self._each("swing") * self._press[device.number].strength(time_s)).astype(np.int64)
        told: list[int] = (self._each("rest") + felt).tolist()
        return told

    def on_timer(self, device: Device, name: str, time_ns: int) -> None:  # noqa: ARG002
        """What a device does by itself; by default it has one timer, for its data."""
        self.burst(device, time_ns)

    def kinds(self) -> Sequence[str]:
        """Name the kinds of frames with data that the devices send, for the option ``silence``."""
        return [self.kind_of(identifier, b"") for identifier in sorted(self.identifiers)]

    # What a subclass may use

    def start(self, device: Device, now_ns: int, period_s: float | None = None) -> None:
        """Make a device send by itself, if it does not yet; each has a phase of its own."""
        if device.streams_from_ns is None:
            period_ns = round((period_s or self.period_s) * 1e9)
            device.streams_from_ns = now_ns
            phase = float(np.random.default_rng([self.options.seed, device.number, 4]).uniform(0.02, 1))
            device.every(_DATA, period_ns, now_ns + max(1, round(phase * period_ns)))

    def stop(self, device: Device) -> None:
        """Make it silent; what is on its way still goes out."""
        device.streams_from_ns = None
        device.stop(_DATA)

    def change_period(self, device: Device, now_ns: int, period_s: float) -> None:
        """Make it send at other times, if it sends by itself."""
        if device.streams_from_ns is not None:
            self.stop(device)
            self.start(device, now_ns, period_s)

    def reply(self, device: Device, frame: CanFrame, now_ns: int) -> None:
        """Send one frame beside the data."""
        self._check([frame])
        device.transmitter.queue.append(Transmission(now_ns + _REPLY_NS, [frame[0]], [frame[1]]))

    def burst(self, device: Device, time_ns: int) -> None:
        """Send what is felt now; faults happen here."""
        device.sampled_ns = time_ns
        frames = list(self.frames(device, self._values(device, time_ns)))
        delay_ns = self._delay(device, time_ns)
        self._send(device, frames, time_ns, time_ns + delay_ns)
        device.cycle += 1
        self.counts["bursts"] += 1

    def lose_power_for_a_moment(self, device: Device, now_ns: int) -> None:
        """Restart a device, as a command that tells it to may do."""
        self._lose_power(device, now_ns)
        ready_ns = now_ns + round(self.options.boot_s * 1e9)
        self.log.append(events.BoardRestarted(time_ns=now_ns, board=device.number, ready_ns=ready_ns))
        device.alive, device.ready_ns = True, ready_ns

        def boot(time_ns: int) -> None:
            if device.alive and device.ready_ns == ready_ns:  # else it lost its power again
                self.boot(device, time_ns)

        self.schedule(ready_ns, boot)

    # Faults at a moment of the caller's choice

    def kill(self, number: int, now_ns: int) -> None:
        """Make a device fall silent and deaf for good; what it had waiting for the wire is lost."""
        self._die(self.devices[number], self.run_to(now_ns))
        self.find_next_event()

    def restart(self, number: int, now_ns: int) -> None:
        """Cut a device's power for a moment (a dead one lives again): configuration lost, deaf for a while."""
        self.lose_power_for_a_moment(self.devices[number], self.run_to(now_ns))
        self.find_next_event()

    # Within

    def power_up(self, now_ns: int) -> Sequence[Actor]:
        """Make the devices."""
        options, places = self.options, self.places()
        self._n_values = len(places)
        for number in self.numbers:
            self.devices[number] = Device(number, self, self.wire.attach(), now_ns)
            self._random[number] = np.random.default_rng([options.seed, number, 1])
            self._press[number] = Press(options.seed, number, places)
        for device in self.devices.values():
            self.boot(device, now_ns)
        for numbers, after_s, action in (
            (options.dead, options.dead_after_s, self._die),
            (options.restart, options.restart_after_s, self.lose_power_for_a_moment),
        ):
            for number in numbers:
                self.schedule(now_ns + round(after_s * 1e9), partial(action, self.devices[number]))
        self.plan_silence(options.silence, self.kinds(), options.silence_after_s, now_ns)
        return [*self.devices.values(), *self._foreign(now_ns)]

    def hear(self, identifier: int, payload: bytes, now_ns: int) -> list[int]:
        """Let every device hear a frame of the host."""
        return [
            device.number
            for device in self.devices.values()
            if device.alive and now_ns >= device.ready_ns and self.obey(device, identifier, payload, now_ns)
        ]

    def _foreign(self, now_ns: int) -> list[ForeignTraffic]:
        if not self.options.foreign_hz:
            return []
        random = np.random.default_rng([self.options.seed, 2])
        others = np.setdiff1d(np.arange(0x7FF), np.array(sorted(self.identifiers)))
        identifiers = random.choice(others, min(_FOREIGN_IDENTIFIERS, len(others)), replace=False).tolist()
        identifiers += [EXTENDED_FLAG | 0x1234_0000 | own & 0x7FF for own in sorted(self.identifiers)[:4]]
        hz = self.options.foreign_hz
        return [ForeignTraffic(identifiers, hz, random, self.wire.attach(), self.log, self.counts, now_ns)]

    def _values(self, device: Device, time_ns: int) -> list[int]:
        if self._source is not None:
            return list(self._source(device.number, device.cycle))
        if self.options.pattern == "cycle":
            return [device.cycle % (int(self._each("full_scale").min()) + 1)] * self._n_values
        told: list[int]
        if self.options.pattern == "idle":
            told = self._each("rest").tolist()
            return told
        from_ns = device.ready_ns if device.streams_from_ns is None else device.streams_from_ns
        felt = self.feel(device, (time_ns - from_ns) * 1e-9)
        told = np.clip(felt, self._each("lowest"), self._each("full_scale")).tolist()
        return told

    def _each(self, name: str) -> npt.NDArray[np.int64]:
        return each_value(name, getattr(self, name), self._n_values)

    def _delay(self, device: Device, time_ns: int) -> int:
        if not self.options.jitter_us:
            return 0
        delay_ns = int(self._random[device.number].integers(0, self.options.jitter_us, endpoint=True)) * 1000
        if delay_ns:
            self.log.append(
                events.BurstDelayed(time_ns=time_ns, board=device.number, cycle=device.cycle, delay_ns=delay_ns)
            )
        return delay_ns

    def _check(self, frames: Sequence[CanFrame]) -> None:
        if self.medium == "can":
            for identifier, _ in frames:
                check_identifier(identifier)

    def _send(self, device: Device, frames: Sequence[CanFrame], time_ns: int, ready_ns: int) -> None:
        self._check(frames)
        options, random = self.options, self._random[device.number]
        chances = (options.lose, options.truncate, options.corrupt, options.repeat)
        hit = random.random((len(frames), len(chances))) < chances
        identifiers: list[int] = []
        payloads: list[bytes] = []
        lost: set[int] = set()
        for position, (identifier, payload) in enumerate(frames):
            fault = _FAULTS[int(hit[position].argmax())] if hit[position].any() else None
            if len(device.transmitter) + len(identifiers) >= self.longest_queue:
                fault = "unsent"
            sent = payload
            if fault == "truncated":
                sent = payload[: int(random.integers(0, max(1, len(payload))))]
            elif fault == "corrupted":
                sent = random.bytes(len(payload))
            if fault is not None:
                self._note(device, time_ns, (device.cycle, position), (identifier, sent), fault)
            if fault == "lost":
                lost.add(len(identifiers))
            times = {"unsent": 0, "repeated": 2}.get(fault or "", 1)
            identifiers += [identifier] * times
            payloads += [sent] * times
        if identifiers:
            device.transmitter.queue.append(Transmission(ready_ns, identifiers, payloads, lost, cycle=device.cycle))

    def _die(self, device: Device, now_ns: int) -> None:
        self._lose_power(device, now_ns)
        self.log.append(events.BoardDied(time_ns=now_ns, board=device.number))

    def _lose_power(self, device: Device, now_ns: int) -> None:
        device.alive = False
        for burst in device.transmitter.queue:
            for at in range(burst.sent, len(burst.identifiers)):
                if burst.cycle >= 0 and at not in burst.lost:
                    frame = burst.identifiers[at], burst.payloads[at]
                    self._note(device, now_ns, (burst.cycle, at), frame, "unsent")
        device.transmitter.queue.clear()
        device.clear()

    def _note(
        self, device: Device, time_ns: int, where: tuple[int, int], frame: CanFrame, fault: events.FrameDamage
    ) -> None:
        cycle, position = where
        self.counts["lost" if fault == "unsent" else fault] += 1
        self.log.append(
            events.FrameFault(
                time_ns=time_ns,
                board=device.number,
                cycle=cycle,
                position=position,
                identifier=frame[0],
                fault=fault,
                payload=frame[1].hex(),
            )
        )


_FAULTS: tuple[events.FrameDamage, ...] = ("lost", "truncated", "corrupted", "repeated")


def each_value(name: str, said: int | Sequence[int], n_values: int) -> npt.NDArray[np.int64]:
    """(n_values,) int64: what an emulator says of its values, in one number or one by one.

    Raises:
        ConfigurationError: it says it of another number of values.
    """
    numbers = np.asarray(said, np.int64)
    if numbers.shape not in ((), (n_values,)):
        raise ConfigurationError(f"{name} has {numbers.size} numbers, `places` tells of {n_values} values")
    return np.broadcast_to(numbers, n_values)
