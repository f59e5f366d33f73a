"""The contacts of a scene as its taxels feel them; the loops are in ``native/touching.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.native import give_arrays
from skinware_drivers import native
from skinware_drivers.native import structs
from skinware_drivers.virtual.physics.taxels import BoundTaxels

ArrayF = npt.NDArray[np.float64]

_FEWEST = 64
_WIDTHS = {"geom": 2, "place": 3, "frame": 9, "force": 6}
_FOUND = {"module": 1, "point_m": 3, "normal": 3, "normal_n": 1, "shear_n": 3, "slip_m_s": 1}


class Touching(NamedTuple):
    """One contact of a module in the newest step.

    Attributes:
        point_m: (3,) in the frame of its body, m.
        normal: (3,) outwards, in the same frame.
        shear_n: (3,) in the same frame, on the module, N.
        slip_m_s: speed of the other body along the surface, m/s.
    """

    module: int
    point_m: ArrayF
    normal: ArrayF
    normal_n: float
    shear_n: ArrayF
    slip_m_s: float


class SceneContacts:
    """Finds which contacts of a scene its modules feel, and spreads their forces over taxels.

    Args:
        sensors: where the data of each module's tactile sensors are.
    """

    def __init__(
        self, model: Any, data: Any, modules: Sequence[BoundTaxels], sensors: Sequence[Sequence[slice]]
    ) -> None:
        library = native.library().quick
        self._find, self._spread = library.skinware_touching_find, library.skinware_touching_spread
        self._find.restype = ctypes.c_int64
        self._model, self._data = model, data
        counts = [len(module.position_m) for module in modules]
        self._first = np.cumsum([0, *counts])
        feels = np.zeros((len(modules), model.ngeom), bool)
        for number, module in enumerate(modules):
            feels[number, module.geoms] = True
        sensor_module = np.repeat(np.arange(len(modules)), [len(of_module) for of_module in sensors])
        own: dict[str, npt.NDArray[Any]] = {
            "feels": feels,
            "first": self._first,
            "body": model.geom_bodyid.astype(np.int64),
            "root": model.body_rootid.astype(np.int64),
            "sensor_module": sensor_module,
            "sensor_at": np.array([values.start for of_module in sensors for values in of_module], np.int64),
            "reach_m": np.array([module.reach_m for module in modules]),
            "position_m": np.concatenate([module.position_m for module in modules]),
            "axes": np.concatenate([module.axes for module in modules]),
            "xpos": data.xpos,
            "xmat": data.xmat,
            "cvel": data.cvel,
            "com": data.subtree_com,
            "sensordata": data.sensordata,
        }
        n = int(self._first[-1])
        self._words = structs.Touching(
            n_modules=len(modules), n_geoms=model.ngeom, n_taxels=n, n_sensors=len(sensor_module)
        )
        self._at = ctypes.byref(self._words)
        self._most = 0
        self._kept = give_arrays(self._words, n, {"felt_n": 3 * n}, own)
        self._make_room(_FEWEST)

    def touches(self) -> list[Touching]:
        """Return what the modules feel of the contacts of the newest step."""
        n = int(self._data.ncon)
        if not n:
            return []
        if n > self._most:
            self._make_room(2 * n)
        contact, kept = self._data.contact, self._kept
        kept["geom"][:n], kept["place"][:n], kept["frame"][:n] = contact.geom, contact.pos, contact.frame
        for number, force in enumerate(kept["force"][:n]):
            mujoco.mj_contactForce(self._model, self._data, number, force)
        found = self._find(self._at, ctypes.c_int64(n))
        module, point_m, normal, normal_n, shear_n, slip_m_s = (kept[name][:found].copy() for name in _FOUND)
        rows = zip(module.tolist(), point_m, normal, normal_n.tolist(), shear_n, slip_m_s.tolist(), strict=True)
        return [Touching(*row) for row in rows]

    def spread(self, n: int) -> list[ArrayF]:
        """Return (taxels, 3) the forces of ``n`` touches, which ``touches`` found last, on each module's taxels, N."""
        self._spread(self._at, ctypes.c_int64(n))
        felt_n = self._kept["felt_n"].reshape(-1, 3).copy()
        return [felt_n[first:end] for first, end in zip(self._first, self._first[1:], strict=False)]

    def _make_room(self, most: int) -> None:
        """Make memory for so many contacts, each of which may be felt at both of its sides."""
        self._most = most
        for name, width in _WIDTHS.items():
            self._kept[name] = np.zeros((most, width), np.int64 if name == "geom" else np.float64)
        for name, width in _FOUND.items():
            shape = (2 * most + 1,) if width == 1 else (2 * most + 1, width)
            self._kept[name] = np.zeros(shape, np.int64 if name == "module" else np.float64)
        for name in (*_WIDTHS, *_FOUND):
            setattr(self._words, name, self._kept[name].ctypes.data)
