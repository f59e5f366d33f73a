"""The contract of emulated hardware: frames in and frames out, at times that the caller passes."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast, runtime_checkable

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.loading import ClassKind, load, registered
from skinware_drivers.virtual.events import Event

if TYPE_CHECKING:  # needs numpy: commands show the options of emulators fast
    from skinware.geometry import Geometry

EMULATORS = "skinware.emulators"
"""The entry point group of emulators; each registers under the name of its driver."""


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
    """The receiver of the events of emulated hardware, for example a list."""

    def append(self, event: Event, /) -> None:
        """Take one event. Events come in order of time, except those of a burst, which come together."""


@runtime_checkable
class EmulatedHardware(Protocol):
    """Devices on one bus. They never sleep and read no clock: the bus passes the time to each call.

    The first call with a time powers the devices up, so a bus begins with ``skip``. A time before that of an earlier
    call counts as that one.

    ``Options`` is a ``msgspec.Struct`` whose fields are the emulator's options: ``skin-emulate`` makes command-line
    options of them, ``--bus virtual?key=value`` bus options.
    """

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take one frame from the bus. Frames that mean nothing to the devices are ignored."""

    def next_due_ns(self) -> int | None:
        """Return when ``emit`` is worth calling again; None while everything is silent.

        No frame is due earlier. Possibly none is due then either, for example if every frame of a burst was lost.
        """

    def emit(self, now_ns: int) -> list[WireFrame]:
        """Return the frames due by ``now_ns`` that were not returned before, oldest first, with their due times."""

    def skip(self, now_ns: int) -> int:
        """Let the devices run on to ``now_ns`` without a listener: cheap, however long that is.

        Returns:
            The number of frames that went unheard.
        """

    def totals(self) -> dict[str, int]:
        """Return exact counts since power-up; at least ``frames`` (returned by ``emit``), ``bursts``, ``commands``."""


class Pressing(NamedTuple):
    """A press on the emulated skin."""

    at_m: Point
    """Place, in the coordinate frame of the sensors, m."""
    force_n: float = 3.0
    radius_m: float = 0.006
    """Radius of the pressing object."""
    seconds: float = 1.0

    @classmethod
    def of(cls, at_m: Any, force_n: Any, radius_m: Any, seconds: Any) -> Pressing:
        """Check the arguments of a program.

        Raises:
            ValueError: they make no sense.
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
        """Return place (m, in the coordinate frame of the sensors) and force (N) of each press at ``now_ns``."""

    def geometry(self) -> Geometry:
        """Return the places of the sensors, by the types and uids of their driver."""

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press from ``now_ns`` on; return the nearest sensor, in the hardware's own terms.

        Raises:
            ValueError: no sensor would feel it, or there are too many presses at a time.
        """


def _number(name: str, value: Any, least: float, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise ValueError(f"{name} {value!r}: give a number from {least:g} to {most:g}")
    return float(value)


class HardwareFactory(Protocol):
    """A class with ``Options``, as the entry points of group ``skinware.emulators`` name it."""

    Options: type[msgspec.Struct]

    def __call__(self, options: Any, *, log: EventLog | None = None) -> EmulatedHardware:
        """Make the devices. ``options`` is an instance of ``Options``; ``log`` receives their events."""


_EMULATOR = ClassKind(
    "emulator",
    EMULATORS,
    "Emulator",
    lambda found: issubclass(found, EmulatedHardware) and hasattr(found, "Options"),
    instead="; without one, its driver needs the real devices, as on --bus can0",
)


def medium_of(emulator: HardwareFactory) -> str:
    """Return the medium of the devices: the attribute ``medium`` of the class, or ``can``."""
    medium: str = getattr(emulator, "medium", "can")
    return medium


def emulators_instead(medium: str) -> str:
    """Name the emulators that drivers of a medium can use instead, for people; empty if there are none."""
    fitting = []
    for name in sorted(registered(EMULATORS)):
        with contextlib.suppress(ConfigurationError):  # an emulator that cannot be loaded is no help
            if medium_of(load_emulator(name)) == medium:
                fitting.append(f"virtual:{name}")
    return f"; emulators that fit: {', '.join(fitting)}" if fitting else ""


def put_away(hardware: EmulatedHardware) -> None:
    """Take away what devices publish beside their frames, if they do."""
    close = getattr(hardware, "close", None)
    if close is not None:
        close()


def name_of(emulator: type) -> str:
    """Return the name under which an emulator is registered; if it is not, that of its module."""
    here = f"{emulator.__module__}:{emulator.__qualname__}"
    names = (name for name, entry in registered(EMULATORS).items() if entry.value == here)
    return next(names, emulator.__module__.rpartition(".")[2])


def load_emulator(name: str) -> HardwareFactory:
    """Return the emulator of a name; see :func:`skinware_drivers.loading.load`.

    Raises:
        ConfigurationError: there is no such emulator, or it cannot be loaded.
    """
    return cast("HardwareFactory", load(_EMULATOR, name))
