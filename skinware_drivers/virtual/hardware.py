"""The contract of emulated hardware: frames in and frames out, and a log of its faults and commands."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, cast, runtime_checkable

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.loading import ClassKind, load, registered

if TYPE_CHECKING:
    from skinware.geometry import Geometry


Half = Literal["head", "tail"]
FrameDamage = Literal["lost", "truncated", "corrupted", "repeated", "unsent"]
"""``unsent``: the device lost its power, or its queue was full; no program received it either."""
EventName = Literal[
    "frame_fault",
    "burst_delayed",
    "board_died",
    "board_restarted",
    "board_silenced",
    "error_reported",
    "recalibrated",
    "triangle_fault",
    "taxel_out_of_range",
    "foreign_frame",
    "command_received",
]


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """One event; as a JSON line it has the fields of its kind.

    ======================  ============================================================================================
    event                   meaning, and fields besides ``time_ns``
    ======================  ============================================================================================
    ``frame_fault``         a data frame was damaged: board, cycle, position, identifier, fault, payload; where no
                            program received it, reason (``random``, ``overflow`` of the device's queue, ``died``,
                            ``restarted``); for a half of a triangle also triangle, half
    ``burst_delayed``       a burst began ``delay_ns`` late, the next one on time: board, cycle, delay_ns
    ``board_died``          the board sends and hears nothing from now on: board
    ``board_restarted``     the board lost power for a moment and is deaf until ``ready_ns``: board, ready_ns
    ``board_silenced``      a discovery silenced a streaming MTB3, as it does to real ones: board
    ``error_reported``      a device reported an error (CANopen EMCY), or with code 0 its end: board, code
    ``recalibrated``        a board took new baselines, so that values jump: board, cycle (the first with them), reason
                            (``power_up``, ``command``, ``no_ack``)
    ``triangle_fault``      a triangle changed: board, triangle, cycle (the first that shows it), fault (``unplugged``,
                            ``plugged_in``, ``no_ack``, ``ack``)
    ``taxel_out_of_range``  a taxel is broken from power-up on: board, triangle, taxel
    ``foreign_frame``       another device on the bus sent a frame: identifier, length
    ``command_received``    boards obeyed or answered a frame of the host: identifier, payload, boards
    ======================  ============================================================================================

    Attributes:
        time_ns: CLOCK_MONOTONIC ns of the bus that carries the frames.
        board: number of the device; of ROBOSKIN boards, the CAN address.
        cycle: number of the device's burst since power-up, from 0.
        position: of the frame in its burst, from 0; of ``unsent`` ones, in the burst after its other faults.
        identifier: with ``EXTENDED_FLAG`` for 29-bit identifiers.
        payload: hexadecimal digits, as it was sent; of lost frames, as it would have been.
        boards: the devices that obeyed or answered, by their numbers before that.
    """

    event: EventName
    time_ns: int
    board: int = -1
    triangle: int = -1
    taxel: int = -1
    cycle: int = -1
    position: int = -1
    identifier: int = -1
    half: Half | None = None
    fault: str | None = None
    reason: str | None = None
    payload: str | None = None
    length: int = -1
    delay_ns: int = -1
    ready_ns: int = -1
    code: int = -1
    boards: Sequence[int] = ()


class JsonLinesLog:
    """Write events to a file, one JSON object a line, each as soon as it happens."""

    def __init__(self, path: str | Path) -> None:
        self._encoder = msgspec.json.Encoder()
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise ConfigurationError(f"cannot write the log {path}: {error.strerror}") from error

    def append(self, event: Event) -> None:
        self._file.write(self._encoder.encode(event) + b"\n")

    def close(self) -> None:
        self._file.close()


EMULATORS = "skinware.emulators"
"""The entry point group of emulators; each registers under the name of its driver."""


_LONGEST_BACKLOG_NS = 1_000_000_000
_FARTHEST_M, _STRONGEST_N, _WIDEST_M, _SHORTEST_S, _LONGEST_S = 100.0, 100.0, 0.1, 0.05, 3600.0


Point = tuple[float, float, float]
"""x, y and z, m."""


class WireFrame(NamedTuple):
    time_ns: int
    """When it went onto the wire, CLOCK_MONOTONIC ns."""
    identifier: int
    """With ``EXTENDED_FLAG`` for 29-bit identifiers, as in :class:`skinware_drivers.bus.FrameBatch`."""
    payload: bytes


class EventLog(Protocol):
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


def due_frames(hardware: EmulatedHardware, now_ns: int) -> tuple[list[WireFrame], int]:
    """Return the frames that are due, and how many are dropped for their age, as from a full receive buffer."""
    due_ns, too_old = hardware.next_due_ns(), 0
    if due_ns is not None and due_ns < now_ns - _LONGEST_BACKLOG_NS:
        too_old = hardware.skip(now_ns - _LONGEST_BACKLOG_NS)
    return hardware.emit(now_ns), too_old


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
    return cast("HardwareFactory", load(_EMULATOR, name))
