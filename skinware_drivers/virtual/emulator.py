"""The base class of emulators of small devices.

A subclass declares its devices, the commands that they obey, and the frames that they send with given values; see
:class:`Emulator`. The touch of a wandering finger is here, by time and seed alone; time, power and faults are in
:mod:`.stage`. Emulators share no code and no table with the drivers that they test.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.bus import EXTENDED_FLAG, check_identifier
from skinware_drivers.virtual.device import DATA, Device
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.stage import OptionsT, Stage

CanFrame = tuple[int, bytes]
"""Identifier and payload; an identifier of 29 bits has the flag, as in ``EXTENDED_FLAG | 0x18DA00F1``."""
Places = npt.NDArray[np.float64]
"""(n, 3) places of the values of a device: x and y on a pad, 0 to 1, and the number of the pad; (n, 2): on one pad."""
Source = Callable[[int, int], Sequence[int]]
"""(number of the device, number of its burst) -> the values that it sends, instead of felt ones."""

_FOREIGN_IDENTIFIERS = 40
_PRESS_S, _PAUSE_S, _RAMP_S = 2.6, 1.4, 0.5
_PRESSES, _REST_S = 6, 6.0
"""Presses in a row, and the rest after them, in which a baseline can begin."""
_REACH, _STROKE = 2.2, 1.0
"""Radius of the pressed spot, and half the way that it strokes, in rows and columns."""
_COARSEST = 0.25
"""Most that a row or column counts; a pad is 1 wide."""
_GOLDEN = 0.618
_FINGERS, _ONE_HAND = 3, 5
"""Pads that are pressed at once where there are as many as on a hand; of fewer pads, one is."""


class WanderingPress:
    """Fingers that press one pad of a device after another, each time somewhere else, and stroke them a little.

    Args:
        number: of the device; devices with other numbers feel other presses.
    """

    def __init__(self, seed: int, number: int, places: Places) -> None:
        random = np.random.default_rng([seed, number, 3])
        self._phase = random.uniform(0, 1)
        self._first_s = random.uniform(0, _PAUSE_S)
        self._places = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
        self._pads = [np.flatnonzero(self._places[:, 2] == pad) for pad in np.unique(self._places[:, 2])]

    def strength(self, time_s: float) -> npt.NDArray[np.float64]:
        """Return (n,) strengths, 0 to 1, at a time since the device began to send."""
        since_s = time_s - self._first_s
        rounds, in_round_s = divmod(since_s, _PRESSES * (_PRESS_S + _PAUSE_S) + _REST_S)
        press, moment_s = divmod(in_round_s, _PRESS_S + _PAUSE_S)
        strength = np.zeros(len(self._places))
        if since_s <= 0 or press >= _PRESSES or moment_s >= _PRESS_S:
            return strength
        presses = int(rounds) * _PRESSES + int(press)
        count = len(self._pads)
        ramp = min(min(moment_s, _PRESS_S - moment_s) / _RAMP_S, 1.0)
        for number in range(presses, presses + count, -(-count // (_FINGERS if count >= _ONE_HAND else 1))):
            pad = self._pads[number % count]
            at = (self._phase + number * _GOLDEN) % 1
            away = self._places[pad, :2] - self._places[pad[int(at * len(pad))], :2]
            away /= np.abs(away).min(axis=0, initial=_COARSEST, where=away != 0)
            away -= _STROKE * (2 * moment_s / _PRESS_S - 1) * np.array([math.cos(9 * at), math.sin(9 * at)])
            strength[pad] = ramp * np.maximum(0, 1 - (away**2).sum(axis=1) / _REACH**2)
        return strength


class Emulator(Stage[OptionsT]):
    """Emulated devices on one bus. Subclasses define the following.

    :class:`skinware_drivers.virtual.stage.Stage` has faults and time.

    The brackets name the class of its options: ``class EmulatedThumb(Emulator[EmulatedThumbOptions])``.

    Args:
        options: of the devices, what they feel, and their faults.
        log: receives each :class:`.hardware.Event`, for example a list.
        source: the values of every burst, instead of felt ones.

    Attributes:
        streams: when devices send by themselves: ``on_command`` (or with the option ``streaming``), ``always``, or
            ``never``, because they only answer.
        identifiers: all that the devices or their host can use; emulated foreign devices use others.
        period_s: time from burst to burst of a device that sends by itself; an option ``period_ms`` sets it.
        full_scale: greatest value that a device can send. This and the next three: one number, or one for each value.
        lowest: least value that it can send.
        rest: value of an untouched sensor.
        swing: what a firm press adds to it.
    """

    streams: Literal["on_command", "always", "never"] = "on_command"
    identifiers: Collection[int] = ()
    full_scale: int | Sequence[int]
    lowest: int | Sequence[int] = 0
    rest: int | Sequence[int] = 0
    swing: int | Sequence[int]

    def __init__(self, options: OptionsT, *, log: EventLog | None = None, source: Source | None = None) -> None:
        super().__init__(options, log=log)
        self._source = source
        self._press: dict[int, WanderingPress] = {}
        self._n_values = 0
        self._eaches: dict[str, tuple[int | Sequence[int], npt.NDArray[np.int64]]] = {}

    # A subclass defines these

    @abstractmethod
    def places(self) -> Places:
        """Return the places of a device's values; see :func:`on_a_grid` and :func:`on_pads`."""

    @abstractmethod
    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """Return the frames of one burst."""

    def boot(self, device: Device, now_ns: int) -> None:
        """Begin what a device does once it has power; by default it streams, as ``streams`` and the options say."""
        if self.streams == "always" or (self.streams == "on_command" and self.options.streaming):
            self.start(device, now_ns)

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        """Return the values of a device's sensors, at a time since it began to send; by default a finger wanders.

        The options ``pattern=idle`` and ``pattern=cycle`` come before this.
        """
        felt = np.rint(self._each("swing") * self._press[device.number].strength(time_s)).astype(np.int64)
        values: list[int] = (self._each("rest") + felt).tolist()
        return values

    def on_timer(self, device: Device, name: str, time_ns: int) -> None:  # noqa: ARG002
        """Do what a device does by itself; by default it has one timer, for its data."""
        self.burst(device, time_ns)

    def kinds(self) -> Sequence[str]:
        """Name the kinds of frames with data, for the option ``silence``; by default those of a burst."""
        values, found = self._each("rest").tolist(), dict[str, None]()
        for device in self.devices.values():
            trial = Device(device.number, deque(), device.ready_ns, self.options.seed)
            trial.memory = dict(device.memory)
            found |= dict.fromkeys(self.kind_of(*frame) for frame in self.frames(trial, values))
        return list(found)

    # A subclass may use these

    def start(self, device: Device, now_ns: int, period_s: float | None = None) -> None:
        """Make a device send by itself, if it does not yet; each has a phase of its own."""
        if device.streams_from_ns is None:
            period_ns = round((period_s or self.period_s) * 1e9)
            device.streams_from_ns = now_ns
            phase = float(np.random.default_rng([self.options.seed, device.number, 4]).uniform(0.02, 1))
            device.every(DATA, period_ns, now_ns + max(1, round(phase * period_ns)))

    def stop(self, device: Device) -> None:
        """Make a device silent; frames on their way still go out."""
        device.streams_from_ns = None
        device.stop(DATA)

    def change_period(self, device: Device, now_ns: int, period_s: float) -> None:
        """Change the period of a device that sends by itself."""
        if device.streams_from_ns is not None:
            self.stop(device)
            self.start(device, now_ns, period_s)

    def pressed(self, added: npt.NDArray[np.float64]) -> list[int]:
        """Return the values of a device whose sensors physics presses by so many counts."""
        return self._in_range(self._each("rest", len(added)) + np.rint(added).astype(np.int64))

    def burst(self, device: Device, time_ns: int) -> None:
        """Send the values that are felt now; faults happen here."""
        device.sampled_ns = time_ns
        frames = self.frames(device, self._values(device, time_ns))
        if self.medium == "can":
            for identifier, _ in frames:
                check_identifier(identifier)
        self.send_burst(device, [frame[0] for frame in frames], [frame[1] for frame in frames], time_ns)

    # Within

    def power_up(self, now_ns: int) -> None:
        """Make the devices and everything else on the bus."""
        places = self.places()
        self._n_values = len(places)
        if self.world is not None:
            self.world.fit(self.numbers, self._n_values)
        self._press = {number: WanderingPress(self.options.seed, number, places) for number in self.numbers}
        super().power_up(now_ns)

    def foreign_identifiers(self, random: np.random.Generator) -> Sequence[int]:
        others = np.setdiff1d(np.arange(0x7FF), np.array(sorted(self.identifiers)))
        identifiers: list[int] = random.choice(others, min(_FOREIGN_IDENTIFIERS, len(others)), replace=False).tolist()
        return identifiers + [EXTENDED_FLAG | 0x1234_0000 | own & 0x7FF for own in sorted(self.identifiers)[:4]]

    def _values(self, device: Device, time_ns: int) -> list[int]:
        if self._source is not None:
            return list(self._source(device.number, device.cycle))
        if self.options.pattern == "cycle":
            return [device.cycle % (int(self._each("full_scale").min()) + 1)] * self._n_values
        from_ns = device.ready_ns if device.streams_from_ns is None else device.streams_from_ns
        touched_s = (time_ns - from_ns) * 1e-9 - self.options.calm_s
        if self.options.pattern == "touch" and touched_s >= 0:
            if self.world is None:
                return self._in_range(self.feel(device, touched_s))
            return self.pressed(self.world.added(device.number, time_ns, self._n_values))
        listed: list[int] = self._each("rest").tolist()
        return listed

    def _in_range(self, felt: Sequence[int] | npt.NDArray[np.int64]) -> list[int]:
        lowest, highest = (self._each(name, len(felt)) for name in ("lowest", "full_scale"))
        values: list[int] = np.minimum(np.maximum(felt, lowest), highest).tolist()
        return values

    def _each(self, name: str, n_values: int | None = None) -> npt.NDArray[np.int64]:
        n_values, given = self._n_values if n_values is None else n_values, getattr(self, name)
        known = self._eaches.get(name)
        if known is None or known[0] is not given or len(known[1]) != n_values:
            known = self._eaches[name] = given, each_value(name, given, n_values)
        return known[1]


def each_value(name: str, given: int | Sequence[int], n_values: int) -> npt.NDArray[np.int64]:
    """Return (n_values,) int64 from one number, or from one for each value."""
    numbers = np.asarray(given, np.int64)
    if numbers.shape not in ((), (n_values,)):
        raise ConfigurationError(f"{name} has {numbers.size} numbers, `places` has {n_values} values")
    return np.broadcast_to(numbers, n_values)


def on_a_grid(count: int, columns: int, each: int = 1) -> Places:
    """Return (count * each, 3) places of sensors in rows on one pad, with ``each`` at the same place."""
    number = np.arange(count)
    rows = -(-count // columns)
    x, y = (number % columns + 0.5) / columns, (number // columns + 0.5) / rows
    return np.repeat(np.stack([x, y, np.zeros(count)], axis=1), each, axis=0)


def on_pads(*shapes: tuple[int, int], each: int = 1) -> Places:
    """Return the places of sensors on several pads, of so many sensors in so many columns; no finger presses two."""
    pads = [on_a_grid(*shape, each) for shape in shapes]
    for number, pad in enumerate(pads):
        pad[:, 2] = number
    return np.concatenate(pads)
