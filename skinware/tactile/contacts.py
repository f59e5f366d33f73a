"""Find contacts, touched taxels that hang together, measure them, and follow them from sample to sample."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware._columns import Index
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.native import give_arrays
from skinware.structure import Structure
from skinware.tactile.arrays import Arrays, Bytes, Columns, Doubles, Flags, Floats, Whole, rows_of
from skinware.tactile.neighbours import STRUCTS, Components, area_m2, pitch_m, posed
from skinware.tactile.neighbours import neighbours as neighbours_of
from skinware.tactile.tracking import ContactKind, Tracker, TrackingSettings
from skinware.tactile.tracks import TouchedBlobs

MOST = 64
"""Most contacts of one sample; of more, those with the largest loads are kept."""
NO_CONTACT, BEYOND = -1, -2
"""Values of ``contact_of``: the taxel is not touched; it is in a contact for which there was no room."""

_find, _list = native.core().quick.skinware_contacts_find, native.core().quick.skinware_contacts_list
_find.argtypes, _find.restype = (ctypes.c_void_p,) * 2, None
_list.argtypes, _list.restype = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p), ctypes.c_int64


@dataclass(frozen=True, eq=False)
class Contact:
    """One contact: attributes as of :data:`COLUMNS`, NaN where not known.

    ``frame`` is the name of its coordinate frame, empty if it is not known; ``taxels`` are (n,) int64, its positions
    among all taxels, ascending. Loads and forces of a contact with clipped taxels are too small.
    """

    id: int
    age_s: float
    load: float
    peak: float
    n: int
    area_m2: float
    cop_m: Floats
    normal: Floats
    force_n: float
    frame: str
    velocity_m_s: Floats
    kind: ContactKind
    slips: bool
    provisional: bool
    clipped: int
    load_whole: float
    uncertainty: float
    taxels: Whole


@dataclass(frozen=True, eq=False)
class ContactSet:
    """All m contacts of one sample, the oldest first; a sequence of :class:`Contact`.

    Each attribute of a contact, but for ``taxels``, has an array (m, ...) here, with the dtype of :data:`COLUMNS`.

    Attributes:
        frame: (m,) int16, index into ``frames``; -1 if it is not known.
        contact_of: (n,) int16, the row of the contact of each taxel; -1: none, -2: one without a row.
        beyond: number of contacts without a row.
        frames: names of the coordinate frames.
    """

    id: npt.NDArray[np.uint32]
    age_s: Floats
    load: Floats
    peak: Floats
    n: npt.NDArray[np.uint32]
    area_m2: Floats
    cop_m: Floats
    normal: Floats
    force_n: Floats
    frame: npt.NDArray[np.int16]
    velocity_m_s: Floats
    kind: Bytes
    slips: Bytes
    provisional: Bytes
    clipped: npt.NDArray[np.uint32]
    load_whole: Floats
    uncertainty: Floats
    contact_of: npt.NDArray[np.int16]
    beyond: int
    frames: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.id)

    def __getitem__(self, row: int) -> Contact:
        row = range(len(self))[row]
        frame = int(self.frame[row])
        return Contact(
            frame=self.frames[frame] if frame >= 0 else "",
            kind=ContactKind(self.kind[row]),
            slips=bool(self.slips[row]),
            provisional=bool(self.provisional[row]),
            taxels=np.flatnonzero(self.contact_of == row),
            **{name: getattr(self, name)[row].item() for name in _NUMBERS},
            **{name: getattr(self, name)[row] for name in _VECTORS},
        )

    def __iter__(self) -> Iterator[Contact]:
        return (self[row] for row in range(len(self)))

    def on(self, taxels: Index, *, above: float = 0.0) -> Contact | None:
        """Return the contact with the largest load of those that have some of these taxels; None without any.

        Args:
            taxels: positions among the n taxels, of any shape: a region's, or a matrix.
            above: the load is larger than this, in the unit of the values; provisional contacts have no load.
        """
        rows = np.unique(self.contact_of[taxels])
        rows = rows[(rows >= 0) & (self.load[rows] > above)]
        return self[int(rows[np.argmax(self.load[rows])])] if len(rows) else None


COLUMNS: Columns = {
    "id": ("<u4", (), "", "the same as long as the contact lasts; 0: this row is empty"),
    "age_s": ("<f4", (), "s", "since it began"),
    "load": ("<f4", (), None, "sum of the values of its taxels"),
    "peak": ("<f4", (), None, "the largest of them"),
    "area_m2": ("<f4", (), "m2", "that its taxels stand for"),
    "force_n": ("<f4", (), "N", "of values in N, or of pressures in Pa by area"),
    "load_whole": ("<f4", (), None, "the load with what threshold and clipping cut off, estimated; NaN: most of it is"),
    "uncertainty": ("<f4", (), None, "how much of the load could be noise or drift; NaN: not known"),
    "n": ("<u4", (), "", "number of its taxels"),
    "clipped": ("<u4", (), "", "number of its taxels that are at the end of their range"),
    "cop_m": ("<f4", (3,), "m", "its centre, in its coordinate frame"),
    "normal": ("<f4", (3,), "", "outwards, of length 1"),
    "velocity_m_s": ("<f4", (3,), "m/s", "of its centre"),
    "frame": ("<i2", (), "", "row of frame_name; -1: not known"),
    "kind": ("u1", (), "", "0: a touch, 1: a hold, 2: sliding"),
    "slips": ("u1", (), "", "1: its pattern moves by more than noise and load explain"),
    "provisional": ("u1", (), "", "1: only the last samples speak for it, and its load is 0"),
}
"""Dtype, shape, unit (None: that of the values) and meaning, per contact, of each array of a :class:`ContactSet`."""
_VECTORS = [name for name, (_, shape, *_) in COLUMNS.items() if shape]
_NUMBERS = [name for name in COLUMNS if name not in ("frame", "kind", "slips", "provisional", *_VECTORS)]


class Contacts:
    """Finds and follows the contacts of n taxels.

    Args:
        n: number of taxels.
        neighbours: (n, k) int, which taxels lie beside each other, -1 fills its rows; None: not known.
        geometry: places of the n taxels; None, or NaN in it: not known. Contacts then have no centre.
        module: (n,) int, module of each taxel; touched taxels without neighbours are one contact per module.
        poses: by name of a coordinate frame, (4, 4) its pose in one that they share: contacts are followed across
            their borders, and have a place in the frame of their peak.
        unit: unit of the values; forces are known where it is ``N`` or ``Pa``.
        tracking: settings of the tracking.

    Raises:
        ConfigurationError: something is not of n taxels.
    """

    def __init__(
        self,
        n: int,
        neighbours: npt.NDArray[Any] | None = None,
        geometry: Geometry | None = None,
        *,
        module: npt.NDArray[Any] | None = None,
        poses: Mapping[str, npt.ArrayLike] | None = None,
        unit: str = "",
        tracking: TrackingSettings | None = None,
    ) -> None:
        for what, given in (("places", geometry), ("modules", module)):
            if given is not None and len(given) != n:
                raise ConfigurationError(f"contacts of {n} taxels: the {what} are of {len(given)}")
        self._n = n
        geometry = geometry if geometry is not None else Geometry.unknown([""] * n, np.zeros(n, np.uint64))
        area, known = area_m2(geometry), np.isfinite(geometry.position_m).all(axis=1)
        names, number = np.unique(geometry.frame[known].astype(str), return_inverse=True)
        self.frames: tuple[str, ...] = tuple(names.tolist())
        self._frame_of = np.full(n, -1, np.int64)
        self._frame_of[known] = number
        poses = {name: pose for name, pose in (poses or {}).items() if name in self.frames}
        common = posed(geometry, poses)
        self._poses = np.array([poses.get(name, np.eye(4)) for name in self.frames], np.float64) if poses else None
        columns = [common.position_m, common.normal, area[:, None], np.isfinite(area)[:, None]]
        of_taxel = np.nan_to_num(np.hstack(columns).astype(np.float64))
        shared = [self.frames.index(min(poses)) if name in poses else row for row, name in enumerate(self.frames)]
        frame_of = np.array([*shared, -1])[self._frame_of]
        pitch = pitch_m(geometry)
        median_m = float(np.nanmedian(pitch)) if np.isfinite(pitch).any() else np.nan
        self._tracker = Tracker(of_taxel[:, :3], median_m, tracking)
        own: Arrays = {"of_taxel": of_taxel, "frame_of": frame_of, "track_of": self._tracker.track_of}
        self._words = words = STRUCTS["Contacts"]()
        self._given = give_arrays(words, n, {}, own)
        words.n, words.is_newtons, words.is_pascals = n, unit == "N", unit == "Pa"
        components = Components(n, neighbours, module)
        words.components = components.at
        slips, found, listed = (STRUCTS[name]() for name in ("Slips", "Found", "Listed"))
        words.slipping, words.found, words.listed = map(ctypes.addressof, (slips, found, listed))
        patterns = [(STRUCTS["Pattern"] * MOST)() for _ in range(2)]
        slips.patterns, slips.before = map(ctypes.addressof, patterns)
        slips.n, slips.least_radius_m = n, float(np.nan_to_num(median_m)) / 6**0.5  # of a square as wide as the pitch
        self._found = give_arrays(found, MOST, dict.fromkeys(_VECTORS, 3 * MOST))
        rows = {name: np.zeros(shape, dtype) for name, (dtype, shape, *_) in rows_of(COLUMNS, MOST).items()}
        self._listed = give_arrays(listed, MOST, {}, rows)
        self._kept = components, slips, found, listed, patterns, give_arrays(slips, n, {})

    @classmethod
    def of(
        cls,
        structure: Structure,
        type_name: str,
        neighbours: npt.NDArray[Any] | None = None,
        tracking: TrackingSettings | None = None,
        poses: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Self:
        """Make one for the sensors of a type of one driver, in the order of ``structure.index(type_name)``.

        Neighbours are found from places and poses, as far as they are known, unless they are given.

        Raises:
            StructureError: the driver has no such sensors.
            ConfigurationError: the neighbours are not of these sensors, or cannot be found from their places.
        """
        module = structure.module_of(type_name)
        geometry = None if structure.geometry is None else structure.geometry[structure.index(type_name)]
        if neighbours is None and geometry is not None:
            neighbours = neighbours_of(posed(geometry, poses or {}))
        unit = structure.type(type_name).unit
        return cls(len(module), neighbours, geometry, module=module, poses=poses, unit=unit, tracking=tracking)

    def update(
        self,
        value: npt.NDArray[Any],
        touched: Flags,
        time_ns: int,
        *,
        onset: Flags | None = None,
        clipped: Flags | None = None,
        uncertainty: npt.NDArray[Any] | None = None,
        sigmas: npt.NDArray[Any] | None = None,
    ) -> ContactSet:
        """Return the contacts of the next sample.

        Args:
            value: (n,) calmed values: 0 = no touch. Values below 0 or not finite count as 0.
            touched: (n,) bool, which taxels are touched.
            time_ns: when the sample was acquired, CLOCK_MONOTONIC ns.
            onset: (n,) bool, which taxels rose in the last samples: contacts of these alone are provisional.
            clipped: (n,) bool, which values are at the end of their range.
            uncertainty: (n,) how much of each value could be noise or drift.
            sigmas: (n,) by how many standard deviations of its noise each is above its baseline; NaN: not known. No
                slip is found without them.

        Raises:
            ConfigurationError: not of n taxels.
        """
        if np.shape(value) != (self._n,) or np.shape(touched) != (self._n,):
            shapes = f"values of {np.shape(value)}, touched of {np.shape(touched)}"
            raise ConfigurationError(f"contacts of {self._n} taxels: {shapes}")
        contact_of = np.empty(self._n, np.int16)
        words, at, to = self._words, ctypes.addressof(self._words), contact_of.ctypes.data
        for name, array in (("onset", onset), ("clipped", clipped), ("uncertainty", uncertainty), ("sigmas", sigmas)):
            setattr(words, f"has_{name}", array is not None)
            if array is not None:
                self._given[name][:] = array
        self._given["value"][:], self._given["touched"][:] = value, touched
        _find(at, to)
        count, most = words.count, 0
        if words.n_touched or not self._tracker.rests(time_ns):
            found = self._found
            of_taxel, m = self._given, words.n_touched
            blobs = TouchedBlobs(
                of_taxel["taxels"][:m],
                of_taxel["contact"][:m],
                of_taxel["load_of"][:m],
                found["load"][:count],
                found["peak"][:count],
                found["frame"][:count],
                found["cop_m"].reshape(-1, 3)[:count],
                found["is_sure"][:count],
                found["frames"][:count],
            )
            for name, array in self._tracker.follow(blobs, time_ns).items():
                found[name][: array.size] = array.reshape(-1)
            most = _list(at, time_ns, to)
        columns = {name: self._listed[name][:most].copy() for name in COLUMNS}
        if self._poses is not None and most:
            self._to_own_frames(columns, contact_of, self._poses)
        return ContactSet(contact_of=contact_of, beyond=words.beyond, frames=self.frames, **columns)

    def _to_own_frames(self, columns: Arrays, contact_of: npt.NDArray[np.int16], poses: Doubles) -> None:
        """Express vectors that were found in the frame shared by poses in that of the peak."""
        taxels, load = (self._given[name][: self._words.n_touched] for name in ("taxels", "load_of"))
        taxels = taxels[np.argsort(load, kind="stable")]
        taxels = taxels[(contact_of[taxels] >= 0) & (self._frame_of[taxels] >= 0)]
        columns["frame"][contact_of[taxels]] = self._frame_of[taxels]  # the last of each contact has its peak
        pose = poses[columns["frame"]]
        columns["cop_m"] -= pose[:, :3, 3]
        for name in _VECTORS:
            columns[name][:] = np.einsum("ki,kij->kj", columns[name], pose[:, :3, :3])
