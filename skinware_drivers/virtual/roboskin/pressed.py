"""What presses the boards of an emulated ROBOSKIN: a finger that wanders over each, and whoever asks to press.

The boards cover a forearm and a hand: boards 7 to 10 one arm, 11 to 14 another beside it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.tactile.testing import ARM_FRAME, Wander, World, arm, arm_path, read_stage
from skinware_drivers.virtual.hardware import Point, Pressing
from skinware_drivers.virtual.roboskin.firmware import CHANNELS, TRIANGLES, ArrayI
from skinware_drivers.virtual.roboskin.options import RoboskinOptions

_FIRST_BOARD = 7
"""Is at the elbow."""
_COUNTS_PER_N = 96
"""Of capacitance: 24 of the values on the wire at the usual shift of 2."""
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
        options: which boards there are, and what presses them.

    Raises:
        ConfigurationError: the file of the option ``stage`` cannot be used.

    Attributes:
        version: changes whenever what is felt from now on does.
    """

    def __init__(self, options: RoboskinOptions) -> None:
        self.version: int = 0
        self._options = options
        numbers = [address - _FIRST_BOARD for address in options.boards]
        self._paths = [arm_path(number) for number in numbers]
        self._world = World(arm(numbers, pads=True), sensitivity=_COUNTS_PER_N)
        self._fingers: dict[int, Wander] = {}
        self._stage = World(self._world.surface, sensitivity=_COUNTS_PER_N)
        self._repeat_s: float | None = None
        self._origin_ns = 0
        if options.stage:
            play = read_stage(options.stage)
            self._stage.gestures += play.gestures
            self._repeat_s = play.repeat_s

    def begin(self, now_ns: int) -> None:
        """The boards get power: from now on the time of the stage file counts."""
        self._origin_ns = now_ns

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press from now on, wherever the board there streams or not.

        Returns:
            The nearest sensor: ``board``, ``triangle``, ``channel``, and ``distance_m`` to its middle.

        Raises:
            ValueError: nothing of the skin would feel it, or too many presses have not ended yet.
        """
        now_s = now_ns / NS_PER_S
        position = self._world.surface.position_m
        distance = np.linalg.norm(position - np.array(press.at_m), axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > self._world.response.reach_m + press.radius_m:
            low, high = (np.round(corner, 3).tolist() for corner in (position.min(axis=0), position.max(axis=0)))
            raise ValueError(
                f"nothing is there: the nearest taxel is {distance[nearest] * 1e3:.0f} mm away;"
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
        """Where somebody presses now, m, and with how many newtons."""
        on_stage_s = float(self._on_stage(np.array([now_ns]))[0])
        found = self._world.pressing(now_ns / NS_PER_S) + self._stage.pressing(on_stage_s)
        return [((float(at[0]), float(at[1]), float(at[2])), force) for _, at, force in found]

    def stream_from(self, ordinal: int, time_ns: int | None) -> None:
        """Say when a board began to stream, or (None) that it lost its power.

        Its finger stays away from it until a second later: otherwise it would be taken for the idle state.
        """
        finger = self._fingers.pop(ordinal, None)
        if finger is not None:
            self._world.gestures.remove(finger)
            self.version += 1
        if time_ns is not None and self._options.pattern == "touch" and not self._options.stage:
            random = np.random.default_rng([self._options.seed, ordinal, 5])
            path = np.roll(self._paths[ordinal], -int(random.integers(len(self._paths[ordinal]))), axis=0)
            finger = Wander(
                path_m=tuple((x, y, z) for x, y, z in path.tolist()),
                force=_FINGER_N,
                radius_m=_FINGER_RADIUS_M,
                begin_s=time_ns / NS_PER_S + _CALM_S + float(random.uniform(0, 1.4)),
                end_s=_NEVER_S,
                rise_s=_RAMP_S,
                speed_m_s=_STROKE_M_S,
                press_s=_STROKE_S,
            )
            self._fingers[ordinal] = finger
            self._world.gestures.append(finger)
            self.version += 1

    def felt(self, ordinal: int, times_ns: ArrayI) -> ArrayI:
        """(m, 16, 12) capacitance counts that presses add on a board, at m times."""
        taxels = slice(ordinal * _SENSORS, (ordinal + 1) * _SENSORS)
        felt = self._world.felt(times_ns / NS_PER_S, taxels)
        if self._stage.gestures:
            felt += self._stage.felt(self._on_stage(times_ns), taxels)
        return felt.astype(np.int64).reshape(-1, TRIANGLES, CHANNELS)

    def _on_stage(self, times_ns: ArrayI) -> npt.NDArray[np.float64]:
        """(m,) seconds of the stage file at m times."""
        since_s: npt.NDArray[np.float64] = (times_ns - self._origin_ns) / NS_PER_S
        return since_s if self._repeat_s is None else since_s % self._repeat_s

    def geometry(self) -> Geometry:
        """Where all sensors are, by the uid that their driver gives them: board << 16 | triangle << 8 | channel.

        A channel is there as a pressure and as a temperature: the driver's options say which of the two it is.
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
