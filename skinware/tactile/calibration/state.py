"""Gather the presses and strokes of a calibration, and keep them in a file so that it can be interrupted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Arrays, Doubles, read_arrays, write_arrays
from skinware.tactile.calibration.force import ForceData
from skinware.tactile.calibration.placing import Press, Presses
from skinware.tactile.calibration.topology import ENOUGH_FRAMES, StrokeSums


@dataclass(frozen=True, kw_only=True)
class PressSettings:
    """The conditions of a steady press.

    Attributes:
        hold_s: how long it lasts.
        steady: share by which its load may change meanwhile.
        still_m: how far its point may move meanwhile, m.
    """

    hold_s: float = 0.2
    steady: float = 0.3
    still_m: float = 0.002


@dataclass
class PressFinder:
    """Finds presses in samples: one each time that something comes to rest on the skin.

    Attributes:
        settings: the conditions of a press.
        held: whether the last press that was found still goes on.
    """

    settings: PressSettings = field(default_factory=PressSettings)
    held: bool = False
    _window: list[tuple[int, Doubles, Doubles]] = field(default_factory=list)
    _found_at_m: Doubles = field(default_factory=lambda: np.full(3, np.nan))
    _passed_m: list[Doubles] = field(default_factory=list)
    """The last two points of its way that are apart by more than it may move while it rests."""

    def update(self, time_ns: int, load: npt.NDArray[Any], pose: Doubles | None) -> Press | None:
        """Take a sample, and return the press that is complete with it.

        Args:
            time_ns: of the sample.
            load: (n,) 0 where nothing touches, NaN where it is not known.
            pose: (3,) or (4, 4), at that time; None or not finite: not known.
        """
        loads = np.nan_to_num(np.asarray(load, np.float64), posinf=0.0)
        total = float(loads.sum())
        self._follow(pose)
        if pose is None or not np.isfinite(pose).all() or total <= 0:
            self._window.clear()
            self.held = self.held and total > 0
            return None
        settings = self.settings
        if self._window:
            _, first_load, first_pose = self._window[0]
            first = float(first_load.sum())
            is_steady = abs(total - first) <= settings.steady * max(total, first)
            if not is_steady or np.linalg.norm(_point(pose) - _point(first_pose)) > settings.still_m:
                self._window.clear()
        if self.held and np.linalg.norm(_point(pose) - _point(self._found_at_m)) > 2 * settings.still_m:
            self.held = False
        self._window.append((time_ns, loads, np.array(pose, np.float64)))
        if self.held or time_ns - self._window[0][0] < settings.hold_s * NS_PER_S:
            if self.held:
                del self._window[:-1]
            return None
        seconds = (time_ns - self._window[0][0]) / NS_PER_S
        velocity = (_point(pose) - _point(self._window[0][2])) / seconds
        way = self._passed_m[1] - self._passed_m[0] if len(self._passed_m) == 2 else np.full(3, np.nan)
        motion = np.concatenate([[time_ns / NS_PER_S], velocity, way / np.linalg.norm(way)])
        mean = np.mean([each for _, each, _ in self._window], axis=0)
        at = np.mean([each for _, _, each in self._window], axis=0)
        at = self._window[-1][2] if at.ndim == 2 else at  # rotations have no mean
        self._window.clear()
        self.held, self._found_at_m = True, at
        taxel = np.flatnonzero(mean > 0)
        return Press(at, taxel, mean[taxel], motion)

    def _follow(self, pose: Doubles | None) -> None:
        if pose is None or not np.isfinite(pose).all():
            self._passed_m.clear()
        elif not self._passed_m or np.linalg.norm(_point(pose) - self._passed_m[-1]) > self.settings.still_m:
            self._passed_m = [*self._passed_m[-1:], _point(pose).copy()]


def _point(pose: Doubles) -> Doubles:
    """(3,) the point, or the origin of the pose."""
    point: Doubles = pose if pose.ndim == 1 else pose[:3, 3]
    return point


class Session(ABC):
    """Gathers presses or strokes until enough taxels are covered; ``kind`` is its name in files."""

    kind: str

    @abstractmethod
    def take(self, time_ns: int, load: npt.NDArray[Any], pose: Doubles | None) -> None:
        """Take a frame, as :meth:`PressFinder.update` does; the pose counts where this session needs one."""

    @property
    @abstractmethod
    def coverage(self) -> Doubles:
        """(n,) 0 to 1: how complete each taxel is."""

    @property
    @abstractmethod
    def figures(self) -> dict[str, int]:
        """Numbers of presses or samples so far."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Return all presses or strokes, for a file."""

    @abstractmethod
    def restore(self, arrays: Arrays) -> None:
        """Go on with the arrays of an equal session; raises ConfigurationError, KeyError or ValueError at others."""

    def is_complete(self, share: float) -> bool:
        return bool((self.coverage >= 1).mean() >= share)


class PressSession(Session):
    """Gathers presses on n taxels.

    Args:
        n: number of taxels.
        wanted: presses wanted of each.
        pose_shape: (3,) for points, (4, 4) for poses of the carrier of a finger.
        settings: the conditions of a press.

    Attributes:
        presses: the presses so far.
    """

    def __init__(
        self, n: int, wanted: int = 5, pose_shape: tuple[int, ...] = (3,), settings: PressSettings | None = None
    ) -> None:
        self.kind = "points" if pose_shape == (3,) else "poses"
        self._n, self._wanted, self._pose_shape = n, wanted, pose_shape
        self._finder = PressFinder(settings or PressSettings())
        self.presses = Presses.none(n, pose_shape)

    def take(self, time_ns: int, load: npt.NDArray[Any], pose: Doubles | None) -> None:
        press = self._finder.update(time_ns, load, pose)
        if press is not None:
            self.presses = self.presses.with_press(press)

    @property
    def coverage(self) -> Doubles:
        return np.minimum(self.presses.times_pressed / self._wanted, 1.0)

    @property
    def figures(self) -> dict[str, int]:
        return {"presses": len(self.presses)}

    def arrays(self) -> Arrays:
        return {name: getattr(self.presses, name) for name in _OF_PRESSES}

    def restore(self, arrays: Arrays) -> None:
        known = Presses(self._n, *(arrays[name] for name in _OF_PRESSES))
        if known.pose.shape[1:] != self._pose_shape:
            raise ConfigurationError(f"it has poses of shape {known.pose.shape[1:]}")
        self.presses = known


class StrokeSession(Session):
    """Gathers strokes over n taxels; raises ConfigurationError if they are too many for a topology."""

    kind = "strokes"

    def __init__(self, n: int) -> None:
        self.sums = StrokeSums.empty(n)

    def take(self, time_ns: int, load: npt.NDArray[Any], pose: Doubles | None) -> None:
        del time_ns, pose  # strokes need neither
        self.sums.add(load)

    @property
    def coverage(self) -> Doubles:
        return np.minimum(self.sums.active / ENOUGH_FRAMES, 1.0)

    @property
    def figures(self) -> dict[str, int]:
        return {"frames": self.sums.frames}

    def arrays(self) -> Arrays:
        one, other = np.nonzero(np.triu(self.sums.products))
        product = self.sums.products[one, other]
        frames = np.array(self.sums.frames)
        return {"one": one, "other": other, "product": product, "active": self.sums.active, "frames": frames}

    def restore(self, arrays: Arrays) -> None:
        n = len(self.sums)
        one, other, product = (arrays[name] for name in ("one", "other", "product"))
        active = arrays["active"]
        if active.shape != (n,) or not len(one) == len(other) == len(product):
            raise ConfigurationError(f"it is not of {n} taxels")
        self.sums = StrokeSums.empty(n)
        self.sums.products[one, other] = self.sums.products[other, one] = product
        self.sums.active[:] = active
        self.sums.frames = int(arrays["frames"])


class ForceSession(Session):
    """Gathers loads of n taxels beside a reference: a force in N, and the temperature of the skin."""

    kind = "forces"

    def __init__(self, n: int) -> None:
        self._n = n
        self._frames: list[tuple[float, Doubles, Doubles]] = []

    def take(self, time_ns: int, load: npt.NDArray[Any], pose: Doubles | None) -> None:
        if pose is not None and np.isfinite(pose[0]):
            self._frames.append((time_ns / NS_PER_S, np.nan_to_num(load), pose))

    @property
    def data(self) -> ForceData:
        """All samples so far."""
        loads = np.array([load for _, load, _ in self._frames]).reshape(-1, self._n)
        force_n, temperature_c = np.array([pose for *_, pose in self._frames]).reshape(-1, 2).T
        return ForceData(np.array([time_s for time_s, *_ in self._frames]), loads, force_n, temperature_c)

    @property
    def coverage(self) -> Doubles:
        pressed = np.zeros(self._n)
        for _, load, _ in self._frames:
            pressed += load > 0
        return np.minimum(pressed / ENOUGH_PRESSED, 1.0)

    @property
    def figures(self) -> dict[str, int]:
        return {"frames": len(self._frames)}

    def arrays(self) -> Arrays:
        data = self.data
        row, taxel = np.nonzero(data.load)
        sparse = {"row": row, "taxel": taxel, "load": data.load[row, taxel]}
        return sparse | {name: getattr(data, name) for name in ("time_s", "force_n", "temperature_c")}

    def restore(self, arrays: Arrays) -> None:
        load = np.zeros((len(arrays["time_s"]), self._n))
        load[arrays["row"], arrays["taxel"]] = arrays["load"]
        pose = np.column_stack([arrays["force_n"], arrays["temperature_c"]])
        self._frames = list(zip(arrays["time_s"].tolist(), load, pose, strict=True))


ENOUGH_PRESSED = 100
"""Samples with a load after which a taxel has enough for a curve."""
_VERSION = 2
_OF_PRESSES = ("pose", "press", "taxel", "load", "motion")
_ARRAYS = "gathered/"


def save_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> None:
    """Write the presses or strokes of a session over (n,) taxels of a type; raises OSError."""
    head = {"kind": np.array(session.kind), "type_name": np.array(type_name), "uid": uid}
    write_arrays(path, _VERSION, head | {f"{_ARRAYS}{name}": array for name, array in session.arrays().items()})


def restore_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> bool:
    """Go on with the presses or strokes of a file, in a new session; return False if there is no such file.

    Raises:
        ConfigurationError: it is no such file, of other taxels, or of another kind of session.
    """
    file = read_arrays(path, _VERSION)
    if file is None:
        return False
    try:
        if str(file["kind"]) != session.kind:
            raise ConfigurationError(f"it has {file['kind']} of a skin, not {session.kind}")
        if str(file["type_name"]) != type_name or not np.array_equal(file["uid"], uid):
            raise ConfigurationError("it is of other sensors")
        session.restore({name.removeprefix(_ARRAYS): file[name] for name in file if name.startswith(_ARRAYS)})
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from None
    return True
