"""The contract of emulated hardware: frames in, frames out, driven by a clock that the caller owns."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast, runtime_checkable

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.loading import Kind, load, registered

if TYPE_CHECKING:  # needs numpy: commands show the options of emulators fast
    from skinware.geometry import Geometry

EMULATORS = "skinware.emulators"
"""The entry point group in which emulators register, under the name of the driver they serve."""


_FARTHEST_M, _STRONGEST_N, _WIDEST_M, _SHORTEST_S, _LONGEST_S = 100.0, 100.0, 0.1, 0.05, 3600.0


Point = tuple[float, float, float]
"""x, y and z, m."""


class WireFrame(NamedTuple):
    """One frame that emulated hardware puts on the wire."""

    time_ns: int
    """When it went onto the wire, CLOCK_MONOTONIC ns."""
    identifier: int
    """With ``EXTENDED_FLAG`` for 29-bit identifiers, as in :class:`skinware_drivers.bus.FrameBatch`."""
    payload: bytes


class EventLog(Protocol):
    """Where emulated hardware writes down what it did: a plain list will do."""

    def append(self, event: msgspec.Struct, /) -> None:
        """Take one event. Events come in order of time, except those of a burst, which come together."""


@runtime_checkable
class EmulatedHardware(Protocol):
    """Devices on one bus. They never sleep and read no clock: whoever carries their frames tells the time.

    The devices are powered up by the first call that tells a time (so a carrier starts with ``skip``). A time
    earlier than one told before counts as that one.

    ``Options`` is a ``msgspec.Struct`` whose fields are the emulator's options: ``skin-emulate`` turns them
    into command-line options, ``--bus virtual?key=value`` into bus options.
    """

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take one frame from the bus. Frames that mean nothing to the devices are ignored."""

    def next_due_ns(self) -> int | None:
        """When ``emit`` is worth calling again; None while everything is silent.

        No frame is due earlier. It can turn out that nothing is due (a burst of which every frame got lost).
        """

    def emit(self, now_ns: int) -> list[WireFrame]:
        """Everything due at ``now_ns`` that was not given before, oldest first, stamped with when it was due."""

    def skip(self, now_ns: int) -> int:
        """Let the devices run on to ``now_ns`` with nobody listening: cheap, however long it was.

        Returns:
            The number of frames that went unheard.
        """

    def totals(self) -> dict[str, int]:
        """Exact counts since power-up; at least ``frames`` (given by ``emit``), ``bursts``, ``commands``."""


class Pressing(NamedTuple):
    """Somebody presses."""

    at_m: Point
    """Where, in the frame of the places, m."""
    force_n: float = 3.0
    radius_m: float = 0.006
    """Of the thing that presses."""
    seconds: float = 1.0

    @classmethod
    def of(cls, at_m: Any, force_n: Any, radius_m: Any, seconds: Any) -> Pressing:
        """What a program asks for.

        Raises:
            ValueError: it makes no sense.
        """
        if not isinstance(at_m, list | tuple) or len(at_m) != 3:
            raise ValueError(f"at_m {at_m!r}: give x, y and z in m")
        x, y, z = (_number("at_m", value, -_FARTHEST_M, _FARTHEST_M) for value in at_m)
        return cls(
            (x, y, z),
            _number("force_n", force_n, 0, _STRONGEST_N),
            _number("radius_m", radius_m, 0, _WIDEST_M),
            _number("seconds", seconds, _SHORTEST_S, _LONGEST_S),
        )


@runtime_checkable
class PlacedHardware(EmulatedHardware, Protocol):
    """Emulated hardware whose sensors have places, at which it can be pressed."""

    def pressing(self, now_ns: int) -> Sequence[tuple[Point, float]]:
        """What presses it at ``now_ns``: where, in the frame of the places, m, and with how many newtons."""

    def geometry(self) -> Geometry:
        """Where the sensors are, by the types and uids of their driver."""

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press from ``now_ns`` on; tells what is nearest, in whatever words the hardware has for it.

        Raises:
            ValueError: nothing would feel it, or there are too many presses at a time.
        """


def _number(name: str, value: Any, least: float, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise ValueError(f"{name} {value!r}: give a number from {least:g} to {most:g}")
    return float(value)


class HardwareFactory(Protocol):
    """What the entry points of group ``skinware.emulators`` name: a class with ``Options``."""

    Options: type[msgspec.Struct]

    def __call__(self, options: Any, *, log: EventLog | None = None) -> EmulatedHardware:
        """Make the devices. ``options`` is an instance of ``Options``; ``log`` takes what they do."""


_EMULATOR = Kind(
    "emulator",
    EMULATORS,
    "Emulator",
    lambda found: issubclass(found, EmulatedHardware) and hasattr(found, "Options"),
    instead="; without one, its driver needs the real devices, as on --bus can0",
)


def medium_of(emulator: HardwareFactory) -> str:
    """What the devices are connected by: ``can``, unless the class says otherwise in its attribute ``medium``."""
    medium: str = getattr(emulator, "medium", "can")
    return medium


def next_read(hardware: EmulatedHardware, waiting: list[bytes], size: int) -> bytes:
    """What a read at the other end of an emulated line gives: all that waits, or one datagram.

    Args:
        hardware: with an attribute ``datagrams`` that is true: what it sends are datagrams.
        waiting: payloads that were sent and not read yet, which are taken out.
        size: bytes that are read at the most.
    """
    if getattr(hardware, "datagrams", False):
        return waiting.pop(0)[:size] if waiting else b""
    data = b"".join(waiting)
    waiting[:] = [data[size:]] if len(data) > size else []
    return data[:size]


def emulators_instead(medium: str) -> str:
    """The emulators that drivers of a medium can use instead, for people; empty if there are none."""
    fitting = []
    for name in sorted(registered(EMULATORS)):
        with contextlib.suppress(ConfigurationError):  # one that cannot be loaded is no help
            if medium_of(load_emulator(name)) == medium:
                fitting.append(f"virtual:{name}")
    return f"; emulators that fit: {', '.join(fitting)}" if fitting else ""


def load_emulator(name: str) -> HardwareFactory:
    """The emulator of a name; see :func:`skinware_drivers.loading.load`.

    Raises:
        ConfigurationError: there is none of that name, or it cannot be loaded.
    """
    return cast("HardwareFactory", load(_EMULATOR, name))
