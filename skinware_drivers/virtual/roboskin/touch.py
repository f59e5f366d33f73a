"""The options and the touch of emulated ROBOSKIN boards: what presses them, and capacitances by pressure and warmth.

A finger wanders over each board, and programs can press. The boards cover a forearm and a hand: boards 7 to 10 one arm,
11 to 14 another beside it. Everything is a function of time and seed, so that runs can be repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.tactile.testing import ARM_FRAME, Wander, World, arm, arm_path, read_stage
from skinware_drivers.virtual.device import Count, EmulatorOptions
from skinware_drivers.virtual.hardware import Point, Pressing

if TYPE_CHECKING:
    from skinware_drivers.virtual.physics.world import PhysicsWorld


_PLACES = ("BOARD", "BOARD/TRIANGLE", "BOARD/TRIANGLE/TAXEL")
_LIMITS = (("board", 1, 14), ("triangle", 0, 15), ("taxel", 0, 11))


class EmulatedRoboskinOptions(EmulatorOptions, frozen=True):
    """The boards, their touch and their faults."""

    boards: Annotated[tuple[int, ...], Meta(description="CAN addresses of the boards, 1-14")] = (7, 8, 9, 10)
    mtb3: Annotated[tuple[int, ...], Meta(description="boards of the older kind MTB3; the others are MTB4")] = ()
    stage: Annotated[str, Meta(description="TOML file of what presses the boards, instead of the wandering press")] = ""
    short_tail: Annotated[
        bool, Meta(description="old firmware: the second frame of a triangle has 6 bytes and no diagnostics")
    ] = False

    not_connected: Annotated[
        tuple[str, ...], Meta(description="triangles that were never plugged in, as BOARD/TRIANGLE")
    ] = ()
    unplugged: Annotated[tuple[str, ...], Meta(description="triangles that get unplugged, as BOARD/TRIANGLE")] = ()
    unplugged_after_cycles: Annotated[Count, Meta(description="bursts of the board before that")] = 20
    no_ack: Annotated[tuple[str, ...], Meta(description="triangles that stop acknowledging, as BOARD/TRIANGLE")] = ()
    no_ack_after_cycles: Annotated[Count, Meta(description="bursts of the board before that")] = 20
    out_of_range: Annotated[
        tuple[str, ...], Meta(description="broken taxels, far out of range, as BOARD/TRIANGLE/TAXEL")
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.boards:
            raise ConfigurationError("option boards: at least one board is needed")
        for address in self.boards:
            if not 1 <= address <= 14:
                raise ConfigurationError(
                    f"option boards: address {address} is outside 1-14 (0 is the host, 15 all boards)"
                )
        if len(set(self.boards)) < len(self.boards):
            raise ConfigurationError("option boards: an address is given twice")
        for name in ("mtb3", "dead", "restart"):
            self._check_boards(name, getattr(self, name))
        for name, depth in (("not_connected", 2), ("unplugged", 2), ("no_ack", 2), ("out_of_range", 3)):
            self._check_boards(name, [place[0] for place in self.places(name, depth)])

    def places(self, name: str, depth: int) -> list[tuple[int, ...]]:
        """Return the places of a list option as numbers.

        Args:
            depth: 2 for (board, triangle), 3 for (board, triangle, taxel).
        """
        found: list[tuple[int, ...]] = []
        for text in getattr(self, name):
            parts = text.split("/")
            if len(parts) != depth or not all(part.isascii() and part.isdigit() for part in parts):
                raise ConfigurationError(f"option {name}: {text!r} is not of the form {_PLACES[depth - 1]}")
            numbers = tuple(int(part) for part in parts)
            for (what, first, last), number in zip(_LIMITS, numbers, strict=False):
                if not first <= number <= last:
                    raise ConfigurationError(f"option {name}: {what} {number} in {text!r} is outside {first}-{last}")
            found.append(numbers)
        return found

    def _check_boards(self, name: str, addresses: Iterable[int]) -> None:
        for address in addresses:
            if address not in self.boards:
                raise ConfigurationError(
                    f"option {name}: there is no board {address}; boards={','.join(map(str, self.boards))}"
                )


TRIANGLES = 16
"""Triangles a board can carry."""
CHANNELS = 12
"""Channels of a triangle: one AD7147 capacitance-to-digital converter."""
ArrayI = npt.NDArray[np.int64]

WireSource = Callable[[int, int, int, int], Sequence[int]]
"""(board address, triangle, cycle, time in ns) -> the 12 values on the wire, 0-255, instead of felt ones."""

DEFAULT_CDC_OFFSET = 0x2200
"""icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/others/AD7147.c"""

_THERMAL_PADS = (6, 10)
_WARMTH = np.array([70, 96, 83, 38, 38, 70, 128, 45, 77, 164, 128, 77]) / 128
"""How strongly each channel follows the warmth of its triangle; 1 for the thermal pads."""
_WARM_COUNTS, _LUKEWARM_COUNTS = 13, 6
"""A slow wave of warmth and a faster one. With any baseline, values on the wire stay below 255, which is at 60 counts
for the usual shift of 2 and no load of 240."""
_NOISE_SCALE, _NOISE_LIMIT = 1.8, 4
"""Noise in counts: at most 2 of the values on the wire at a shift of 2, baseline and reading together."""
_NOISE_PERIOD = 61

_FIRST_BOARD = 7
"""The board at the elbow."""
_COUNTS_PER_N = 96
"""Counts of capacitance: 24 of the values on the wire at the usual shift of 2."""
_FINGER_N, _FINGER_RADIUS_M = 5.0, 0.006
_STROKE_M_S, _STROKE_S = 0.02, 4.6
_RAMP_S = 0.5
_CALM_S = 1.0
_NEVER_S = 1e10
_MOST_PRESSES = 50
_TAXEL_RADIUS_M = 0.002
_SENSORS = TRIANGLES * CHANNELS


class PressedSkin:
    """The skin of all boards, and the presses on it.

    Args:
        physics: a world that presses it, too, instead of the wandering fingers.

    Attributes:
        origin_ns: beginning of the stage file's time.
        version: changes when the touch from now on does, other than with time.
    """

    def __init__(self, options: EmulatedRoboskinOptions, physics: PhysicsWorld | None = None) -> None:
        self.version: int = 0
        self.physics = physics
        self._options = options
        numbers = [address - _FIRST_BOARD for address in options.boards]
        self._paths = [arm_path(number) for number in numbers]
        self._world = World(arm(numbers, pads=True), sensitivity=_COUNTS_PER_N)
        self._fingers: dict[int, Wander] = {}
        self._stage = World(self._world.surface, sensitivity=_COUNTS_PER_N)
        self._repeat_s: float | None = None
        self.origin_ns = 0
        if options.stage:
            play = read_stage(options.stage)
            self._stage.gestures += play.gestures
            self._repeat_s = play.repeat_s

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press from now on, whether the board there streams or not.

        Returns:
            The nearest sensor: ``board``, ``triangle``, ``channel``, and ``distance_m`` to its middle.

        Raises:
            ValueError: no taxel would feel it, or too many presses have not ended yet.
        """
        now_s = now_ns / NS_PER_S
        position = self._world.surface.position_m
        distance = np.linalg.norm(position - np.array(press.at_m), axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > self._world.response.reach_m + press.radius_m:
            low, high = (np.round(corner, 3).tolist() for corner in (position.min(axis=0), position.max(axis=0)))
            raise ValueError(
                f"no taxel is there: the nearest taxel is {distance[nearest] * 1e3:.0f} mm away;"
                f" the skin is between {low} and {high}"
            )
        gestures = self._world.gestures
        gestures[:] = [gesture for gesture in gestures if gesture.end_s > now_s]
        if len(gestures) - len(self._fingers) >= _MOST_PRESSES:
            raise ValueError(f"{_MOST_PRESSES} presses have not ended yet")
        ramp_s = min(0.1, press.seconds / 3)
        self._world.push(
            press.at_m, press.force_n, now_s, now_s + press.seconds, rise_s=ramp_s, radius_m=press.radius_m
        )
        self.version += 1
        board, sensor = divmod(nearest, _SENSORS)
        return {
            "board": self._options.boards[board],
            "triangle": sensor // CHANNELS,
            "channel": sensor % CHANNELS,
            "distance_m": round(float(distance[nearest]), 6),
        }

    def pressing(self, now_ns: int) -> list[tuple[Point, float]]:
        """Return place (m) and force (N) of each press."""
        on_stage_s = float(self._on_stage(np.array([now_ns]))[0])
        found = self._world.pressing(now_ns / NS_PER_S) + self._stage.pressing(on_stage_s)
        return [((float(at[0]), float(at[1]), float(at[2])), force) for _, at, force in found]

    def stream_from(self, ordinal: int, time_ns: int | None) -> None:
        """Note when a board began to stream, or (None) that it lost its power.

        Its finger comes a second later at the earliest, so that it does not become part of a baseline.
        """
        finger = self._fingers.pop(ordinal, None)
        if finger is not None:
            self._world.gestures.remove(finger)
            self.version += 1
        wanders = self._options.pattern == "touch" and not self._options.stage and self.physics is None
        if time_ns is not None and wanders:
            random = np.random.default_rng([self._options.seed, ordinal, 5])
            path = np.roll(self._paths[ordinal], -int(random.integers(len(self._paths[ordinal]))), axis=0)
            finger = Wander(
                path_m=tuple((x, y, z) for x, y, z in path.tolist()),
                force=_FINGER_N,
                radius_m=_FINGER_RADIUS_M,
                begin_s=time_ns / NS_PER_S + max(_CALM_S, self._options.calm_s) + float(random.uniform(0, 1.4)),
                end_s=_NEVER_S,
                rise_s=_RAMP_S,
                speed_m_s=_STROKE_M_S,
                press_s=_STROKE_S,
            )
            self._fingers[ordinal] = finger
            self._world.gestures.append(finger)
            self.version += 1

    def felt(self, ordinal: int, times_ns: ArrayI) -> ArrayI:
        """Return (m, 16, 12) capacitance counts that presses add on a board, at m times."""
        taxels = slice(ordinal * _SENSORS, (ordinal + 1) * _SENSORS)
        felt = self._world.felt(times_ns / NS_PER_S, taxels)
        if self._stage.gestures:
            felt += self._stage.felt(self._on_stage(times_ns), taxels)
        if self.physics is not None:
            felt += np.rint(self.physics.added(self._options.boards[ordinal], int(times_ns[0]), _SENSORS))
        return felt.astype(np.int64).reshape(-1, TRIANGLES, CHANNELS)

    def _on_stage(self, times_ns: ArrayI) -> npt.NDArray[np.float64]:
        """Return (m,) seconds of the stage file at m times."""
        since_s: npt.NDArray[np.float64] = (times_ns - self.origin_ns) / NS_PER_S
        return since_s if self._repeat_s is None else since_s % self._repeat_s

    def geometry(self) -> Geometry:
        """Return the places of all sensors, by the driver's uid: board << 16 | triangle << 8 | channel.

        Each channel has a pressure and a temperature, because the options of the driver choose one of them.
        """
        surface = self._world.surface
        triangle, channel = np.divmod(np.arange(_SENSORS), CHANNELS)
        boards = np.array(self._options.boards)[:, np.newaxis]
        uid = (boards << 16 | triangle << 8 | channel).reshape(-1).astype(np.uint64)
        n = len(uid)
        of_each_type = [
            Geometry(
                type_name=np.full(n, name, object),
                uid=uid,
                frame=np.full(n, ARM_FRAME, object),
                position_m=surface.position_m,
                normal=surface.normal,
                radius_m=np.full(n, _TAXEL_RADIUS_M),
                confidence=np.full(n, np.nan),
            )
            for name in ("pressure", "temperature")
        ]
        return Geometry.joined(of_each_type)


class Touch:
    """The capacitances of one board.

    Args:
        ordinal: of the board; others feel other presses.
        skin: of all boards, with the presses on it; None: an untouched board.
    """

    def __init__(self, seed: int, ordinal: int, skin: PressedSkin | None = None) -> None:
        random = np.random.default_rng([seed, ordinal])
        self._ordinal, self._skin = ordinal, skin
        self.is_known_ahead = skin is None or skin.physics is None  # no physics decides the touch of coming moments
        self._rest = random.integers(0x8800, 0x9800, (TRIANGLES, CHANNELS))
        noise = random.normal(0, _NOISE_SCALE, (_NOISE_PERIOD, TRIANGLES, CHANNELS))
        self._noise = np.clip(np.rint(noise), -_NOISE_LIMIT, _NOISE_LIMIT).astype(np.int64)
        self._noise[:, :, _THERMAL_PADS] //= 4
        self._warmth_phase = random.uniform(0, 2 * math.pi, (TRIANGLES, 1))
        self.streams = False

    def stream_from(self, time_ns: int | None) -> None:
        """Note when the board began to stream, or (None) that it lost its power."""
        self.streams = time_ns is not None
        if self._skin is not None:
            self._skin.stream_from(self._ordinal, time_ns)

    @property
    def version(self) -> int:
        """Changes when the touch from now on does, other than with time."""
        return 0 if self._skin is None else self._skin.version

    def capacitances(self, times_ns: ArrayI, cycles: ArrayI, cdc_offset: ArrayI, *, fingertip: bool) -> ArrayI:
        """Return (n, 16, 12) readings of the converters, 1-65534.

        Args:
            cycles: (n,) of the board, for the noise.
            cdc_offset: (16, 1) offset of the converters, subtracted count for count (assumed: its real scale is not
                known, and vanishes with the next calibration).
            fingertip: all 12 channels feel pressure, and none warmth.
        """
        times_s = times_ns[:, np.newaxis, np.newaxis].astype(np.float64) * 1e-9
        raw: ArrayI = self._rest + self._noise[cycles % _NOISE_PERIOD]
        if self._skin is not None:
            pressure = self._skin.felt(self._ordinal, times_ns)
            if not fingertip:
                pressure[:, :, _THERMAL_PADS] = 0
            raw += pressure
        if not fingertip:
            phase = self._warmth_phase
            warmer = _WARM_COUNTS * np.sin(times_s * (2 * math.pi / 120) + phase)
            warmer += _LUKEWARM_COUNTS * np.sin(times_s * (2 * math.pi / 37) + 2 * phase)
            raw += (warmer * _WARMTH).astype(np.int64)
        raw -= cdc_offset - DEFAULT_CDC_OFFSET
        return np.clip(raw, 1, 0xFFFE, out=raw)


def cycle_pattern(board: int, triangle: int, cycle: int, time_ns: int) -> Sequence[int]:  # noqa: ARG001 - a WireSource
    """Return the cycle's number modulo 256 for all 12 values of a triangle, which shows torn data."""
    return (cycle & 0xFF,) * CHANNELS
