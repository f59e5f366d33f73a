"""Gather presses and strokes of a calibration, and keep them in a file so that it can be interrupted."""

from __future__ import annotations

import contextlib
import os
import zipfile
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.placing import Presses, PressFinder, PressSettings
from skinware.tactile.calibration.topology import ENOUGH_FRAMES, StrokeSums

ArrayF = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[Any]]


class Session(ABC):
    """Gathers until enough taxels are covered.

    Attributes:
        kind: what it gathers, in state files.
    """

    kind: str

    @abstractmethod
    def take(self, time_ns: int, load: npt.NDArray[Any], pose: ArrayF | None) -> None:
        """Take a frame.

        Args:
            time_ns: of it.
            load: (n,) 0 where nothing touches, NaN where it is not known.
            pose: at that time, where this session wants one; None: not known.
        """

    @property
    @abstractmethod
    def coverage(self) -> ArrayF:
        """(n,) 0 to 1: how much of what is wanted each taxel has."""

    @property
    @abstractmethod
    def figures(self) -> dict[str, int]:
        """What was gathered, in numbers."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Everything that was gathered, for a file."""

    @abstractmethod
    def restore(self, arrays: Arrays) -> None:
        """Go on with what an equal session had.

        Raises:
            ConfigurationError, KeyError, ValueError: the arrays do not fit.
        """

    def is_complete(self, share: float) -> bool:
        """Whether at least this part of the taxels have all that is wanted."""
        return bool((self.coverage >= 1).mean() >= share)


class PressSession(Session):
    """Gathers presses.

    Args:
        n: number of taxels.
        wanted: presses of each.
        pose_shape: (3,) for points, (4, 4) for poses of what carries a finger.
        settings: when something presses steadily.
    """

    def __init__(
        self,
        n: int,
        wanted: int = 5,
        pose_shape: tuple[int, ...] = (3,),
        settings: PressSettings | None = None,
    ) -> None:
        self.kind = "points" if pose_shape == (3,) else "poses"
        self._n, self._wanted, self._pose_shape = n, wanted, pose_shape
        self._finder = PressFinder(settings or PressSettings())
        self._known = Presses.none(n, pose_shape)

    @property
    def presses(self) -> Presses:
        """Those found so far."""
        return self._known

    def take(self, time_ns: int, load: npt.NDArray[Any], pose: ArrayF | None) -> None:
        """See :class:`Session`."""
        press = self._finder.update(time_ns, load, pose)
        if press is not None:
            self._known = self._known.with_press(press)

    @property
    def coverage(self) -> ArrayF:
        """See :class:`Session`."""
        return np.minimum(self._known.times_pressed / self._wanted, 1.0)

    @property
    def figures(self) -> dict[str, int]:
        """See :class:`Session`."""
        return {"presses": len(self._known)}

    def arrays(self) -> Arrays:
        """See :class:`Session`."""
        return {name: getattr(self._known, name) for name in ("pose", "press", "taxel", "load")}

    def restore(self, arrays: Arrays) -> None:
        """See :class:`Session`."""
        known = Presses(self._n, *(arrays[name] for name in ("pose", "press", "taxel", "load")))
        if known.pose.shape[1:] != self._pose_shape:
            raise ConfigurationError(f"it has poses of shape {known.pose.shape[1:]}")
        self._known = known


class StrokeSession(Session):
    """Gathers strokes.

    Args:
        n: number of taxels.

    Raises:
        ConfigurationError: there are too many for a topology.
    """

    kind = "strokes"

    def __init__(self, n: int) -> None:
        self.sums = StrokeSums.empty(n)

    def take(self, time_ns: int, load: npt.NDArray[Any], pose: ArrayF | None) -> None:
        """See :class:`Session`."""
        del time_ns, pose  # strokes need neither
        self.sums.add(load)

    @property
    def coverage(self) -> ArrayF:
        """See :class:`Session`."""
        return np.minimum(self.sums.active / ENOUGH_FRAMES, 1.0)

    @property
    def figures(self) -> dict[str, int]:
        """See :class:`Session`."""
        return {"frames": self.sums.frames}

    def arrays(self) -> Arrays:
        """See :class:`Session`."""
        one, other = np.nonzero(np.triu(self.sums.products))
        product = self.sums.products[one, other]
        frames = np.array(self.sums.frames)
        return {"one": one, "other": other, "product": product, "active": self.sums.active, "frames": frames}

    def restore(self, arrays: Arrays) -> None:
        """See :class:`Session`."""
        n = len(self.sums)
        one, other, product = (arrays[name] for name in ("one", "other", "product"))
        active = arrays["active"]
        if active.shape != (n,) or not len(one) == len(other) == len(product):
            raise ConfigurationError(f"it is not of {n} taxels")
        self.sums = StrokeSums.empty(n)
        self.sums.products[one, other] = self.sums.products[other, one] = product
        self.sums.active[:] = active
        self.sums.frames = int(arrays["frames"])


_VERSION = 1
_ARRAYS = "gathered/"


def save_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> None:
    """Write it, in one step: whoever reads the file sees this state or the one before.

    Args:
        path: of the file.
        session: that gathered.
        type_name: of its taxels.
        uid: (n,) of its taxels.

    Raises:
        OSError: it cannot be written.
    """
    arrays = {f"{_ARRAYS}{name}": array for name, array in session.arrays().items()}
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                version=np.array(_VERSION),
                kind=np.array(session.kind),
                type_name=np.array(type_name),
                uid=uid,
                **arrays,
            )
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def restore_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> bool:
    """Go on with what a file has; False if there is no such file.

    Args:
        path: of the file.
        session: a new one.
        type_name: of its taxels.
        uid: (n,) of its taxels.

    Raises:
        ConfigurationError: it is no such file, of other taxels, or of something else than this session gathers.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            if int(file["version"]) != _VERSION:
                raise ConfigurationError(f"{path} is of another version")
            if str(file["kind"]) != session.kind:
                raise ConfigurationError(f"{path} has {file['kind']} of a skin, not {session.kind}")
            if str(file["type_name"]) != type_name or not np.array_equal(file["uid"], uid):
                raise ConfigurationError(f"{path} is of other sensors")
            session.restore({name.removeprefix(_ARRAYS): file[name] for name in file.files if name.startswith(_ARRAYS)})
    except FileNotFoundError:
        return False
    except ConfigurationError as error:
        raise ConfigurationError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from None
    return True
