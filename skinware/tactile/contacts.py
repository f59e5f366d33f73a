"""Find contacts, touched taxels that hang together, measure them, and follow them from frame to frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.structure import Structure
from skinware.tactile.arrays import Bytes, Columns, Doubles, Flags, Floats, Whole, rows_of
from skinware.tactile.neighbours import Components, area_m2, pitch_m
from skinware.tactile.neighbours import neighbours as neighbours_of
from skinware.tactile.slips import Slips
from skinware.tactile.tracking import ContactKind, Tracker, TrackingSettings
from skinware.tactile.tracks import TouchedBlobs

MOST = 64
"""Most contacts of one frame; of more, those with the largest loads are kept."""
NO_CONTACT, BEYOND = -1, -2
"""Values of ``contact_of``: the taxel is not touched; it is in a contact for which there was no room."""

_CLEARLY = 1.5  # a contact must have so many times the load of one that is in the list to take its place
_LEAST_SHARE = 0.1  # share of the newest frame in the value of a taxel that is just touched
_LEAST_SEEN, _MOST_CUT = 0.5, 0.6
"""Least share of a load that must be above the threshold, and largest share of clipped taxels, for an estimate."""


@dataclass(frozen=True, eq=False)
class Contact:
    """One contact.

    Attributes:
        id: the same as long as it lasts, gaps of 60 ms included.
        age_s: since it began, s.
        load: sum of the values of its taxels, in the unit of the values.
        peak: largest value of its taxels.
        n: number of its taxels.
        area_m2: area that they stand for, m2; NaN without places.
        cop_m: (3,) m, its centre: the mean of the places, weighted by the values; NaN without places.
        normal: (3,) of length 1, outwards, weighted in the same way; NaN if it is not known.
        force_n: along the normal, N: the sum of values in N, or of values in Pa by area, at known places; else NaN.
        frame: name of the coordinate frame, empty if it is not known.
        velocity_m_s: (3,) m/s, velocity of the centre; NaN without places.
        kind: a touch (younger than 0.3 s), a hold, or sliding: faster than 5 mm/s at a steady load.
        slips: its pattern moves along the skin by more than noise and the change of its load explain.
        provisional: only its last frames speak for it; the baseline has not confirmed it, and its load is 0.
        clipped: number of its taxels that are at the end of their range: load and force are too small.
        load_whole: estimate of the load with what threshold and clipping cut off, as of a bell; NaN if most is cut off.
        uncertainty: how much of the load could be noise or drift, in its unit; NaN if it is not known.
        taxels: (n,) int64, positions among the n taxels, ascending.
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
    """All m contacts of one frame, the oldest first; a sequence of :class:`Contact`.

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


_WHOLE = "estimate of the load with what threshold and clipping cut off; NaN: most of it is"
COLUMNS: Columns = {
    "id": ("<u4", (), "", "the same as long as the contact lasts; 0: this row is empty"),
    "age_s": ("<f4", (), "s", "since it began"),
    "load": ("<f4", (), None, "sum of the values of its taxels"),
    "peak": ("<f4", (), None, "the largest of them"),
    "area_m2": ("<f4", (), "m2", "that its taxels stand for"),
    "force_n": ("<f4", (), "N", "of values in N, or of pressures in Pa by area"),
    "load_whole": ("<f4", (), None, _WHOLE),
    "uncertainty": ("<f4", (), None, "how much of the load could be noise or drift; NaN: not known"),
    "n": ("<u4", (), "", "number of its taxels"),
    "clipped": ("<u4", (), "", "number of its taxels that are at the end of their range"),
    "cop_m": ("<f4", (3,), "m", "its centre, in its frame"),
    "normal": ("<f4", (3,), "", "outwards, of length 1"),
    "velocity_m_s": ("<f4", (3,), "m/s", "of its centre"),
    "frame": ("<i2", (), "", "row of frame_name; -1: not known"),
    "kind": ("u1", (), "", "0: a touch, 1: a hold, 2: sliding"),
    "slips": ("u1", (), "", "1: its pattern moves by more than noise and load explain"),
    "provisional": ("u1", (), "", "1: only its last frames speak for it, and its load is 0"),
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
        unit: str = "",
        tracking: TrackingSettings | None = None,
    ) -> None:
        for what, given in (("places", geometry), ("modules", module)):
            if given is not None and len(given) != n:
                raise ConfigurationError(f"contacts of {n} taxels: the {what} are of {len(given)}")
        self._n = n
        self._components = Components(n, neighbours, module)
        geometry = geometry if geometry is not None else Geometry.unknown([""] * n, np.zeros(n, np.uint64))
        area = area_m2(geometry)
        of_taxel = [geometry.position_m, geometry.normal, area[:, None], np.isfinite(area)[:, None]]
        self._of_taxel = np.nan_to_num(np.hstack(of_taxel).astype(np.float64))  # place, normal, area, and whether known
        self._unit = unit
        self._least = 0.0  # value of a taxel that is just touched; 0: none was seen yet
        known = np.isfinite(geometry.position_m).all(axis=1)
        names, number = np.unique(geometry.frame[known].astype(str), return_inverse=True)
        self.frames: tuple[str, ...] = tuple(names.tolist())
        self._frame = np.full(n, -1, np.int64)
        self._frame[known] = number
        pitch = pitch_m(geometry)
        median_m = float(np.nanmedian(pitch)) if np.isfinite(pitch).any() else np.nan
        self._tracker = Tracker(self._of_taxel[:, :3], median_m, tracking)
        self._slips = Slips(self._of_taxel[:, :3], median_m)

    @classmethod
    def of(
        cls,
        structure: Structure,
        type_name: str,
        neighbours: npt.NDArray[Any] | None = None,
        tracking: TrackingSettings | None = None,
    ) -> Self:
        """Make one for the sensors of a type of one driver, in the order of ``structure.index(type_name)``.

        Neighbours are found from the places, as far as they are known, unless they are given.

        Raises:
            StructureError: the driver has no such sensors.
            ConfigurationError: the neighbours are not of these sensors, or cannot be found from their places.
        """
        module = structure.module_of(type_name)
        geometry = None if structure.geometry is None else structure.geometry[structure.index(type_name)]
        if neighbours is None and geometry is not None:
            neighbours = neighbours_of(geometry)
        unit = structure.type(type_name).unit
        return cls(len(module), neighbours, geometry, module=module, unit=unit, tracking=tracking)

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
        """Return the contacts of the next frame.

        Args:
            value: (n,) calmed values: 0 = no touch. Values below 0 or not finite count as 0.
            touched: (n,) bool, which taxels are touched.
            time_ns: when the frame was acquired, CLOCK_MONOTONIC ns.
            onset: (n,) bool, which taxels rose in the last frames: contacts of these alone are provisional.
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
        taxels = np.flatnonzero(touched if onset is None else touched | onset)
        contact_of = np.full(self._n, NO_CONTACT, np.int16)
        if not len(taxels) and self._tracker.rests(time_ns):
            nothing = {name: np.zeros(shape, dtype) for name, (dtype, shape, *_) in rows_of(COLUMNS, 0).items()}
            return ContactSet(contact_of=contact_of, beyond=0, frames=self.frames, **nothing)
        contact, count = self._components.of(taxels)
        load = value[taxels].astype(np.float64)
        load = np.where(np.isfinite(load) & (load > 0), load, 0.0)
        beyond = max(0, count - MOST)
        if beyond:
            contact_of[taxels] = BEYOND
            listed = self._tracker.track_of[taxels] >= 0
            taxels, contact, load = _largest(taxels, contact, load, count, listed)
            count = MOST
        found = self._measure(taxels, contact, load, count)
        is_sure, frames = np.ones(count, bool), np.ones(count, np.int64)
        if onset is not None:
            is_sure = np.bincount(contact, touched[taxels], count) > 0
            frames += np.bincount(contact, onset[taxels], count) > 0
        blobs = TouchedBlobs(
            taxels, contact, load, found["load"], found["peak"], found["frame"], found["cop_m"], is_sure, frames
        )
        cut = np.zeros(count)
        if clipped is not None:
            cut += np.bincount(contact, clipped[taxels], count)
        unsure = np.full(count, np.nan) if uncertainty is None else np.bincount(contact, uncertainty[taxels], count)
        found |= {"clipped": cut, "uncertainty": unsure, "load_whole": self._whole(found, cut, load)}
        found |= self._tracker.follow(blobs, time_ns)
        order = np.lexsort([found["id"], -found["age_s"]])
        order = order[found["id"][order] > 0]
        row = np.full(count, NO_CONTACT)
        row[order] = np.arange(len(order))
        contact_of[taxels] = row[contact]
        found["slips"] = np.zeros(count, bool)
        if sigmas is not None:
            found["slips"][order] = self._slipping(
                found["id"][order], found["frame"][order], contact_of, sigmas, time_ns
            )
        columns = {name: found[name][order].astype(dtype) for name, (dtype, *_) in COLUMNS.items()}
        return ContactSet(contact_of=contact_of, beyond=beyond, frames=self.frames, **columns)

    def _slipping(
        self, identity: Whole, frame: Whole, contact_of: npt.NDArray[np.int16], sigmas: npt.NDArray[Any], time_ns: int
    ) -> Flags:
        """(m,) which of the m contacts that have rows slip."""
        taxels = np.flatnonzero(contact_of >= 0)
        contact = contact_of[taxels].astype(np.int64)
        counts = (frame[contact] == self._frame[taxels]) & (frame[contact] >= 0) & np.isfinite(sigmas[taxels])
        return self._slips.update(identity, taxels[counts], contact[counts], sigmas, time_ns)

    def _measure(self, taxels: Whole, contact: Whole, load: Doubles, count: int) -> dict[str, npt.NDArray[Any]]:
        order = np.argsort(contact, kind="stable")
        taxels, contact, load = taxels[order], contact[order], load[order]
        first = np.searchsorted(contact, np.arange(count))  # each contact has at least one taxel
        peak = np.maximum.reduceat(load, first) if count else np.zeros(0)
        frame = self._frame_of(taxels, contact, load, peak)
        of_taxel = self._of_taxel[taxels]
        counts = (frame[contact] == self._frame[taxels]) & (frame[contact] >= 0)
        weight = np.where(counts, load, 0.0)
        if count:  # without any load, each taxel weighs the same
            weight += counts * (np.add.reduceat(weight, first) == 0)[contact]
        parts = np.column_stack(
            [load, load * of_taxel[:, 6], weight, of_taxel[:, 6:], weight[:, None] * of_taxel[:, :6]]
        )
        total = np.add.reduceat(parts, first, axis=0) if count else np.zeros((0, parts.shape[1]))
        loads, forces, weights, areas, with_area = total[:, :5].T
        has_area, normal = with_area > 0, total[:, 8:]
        length = np.sqrt((normal**2).sum(axis=1))
        return {
            "load": loads,
            "peak": peak,
            "n": np.bincount(contact, minlength=count),
            "area_m2": np.where(has_area, areas, np.nan),
            "force_n": {"N": loads, "Pa": np.where(has_area, forces, np.nan)}.get(self._unit, np.full(count, np.nan)),
            "cop_m": total[:, 5:8] / np.where(weights > 0, weights, np.nan)[:, None],
            "normal": normal / np.where(length > 0, length, np.nan)[:, None],
            "frame": frame,
        }

    def _whole(self, found: dict[str, npt.NDArray[Any]], cut: Doubles, load: Doubles) -> Doubles:
        """(count,) the loads of bells of which only the part above the threshold and below the clipping was seen."""
        if len(load) and (load > 0).any():
            least = float(load[load > 0].min())
            self._least = least if not self._least else self._least + _LEAST_SHARE * (least - self._least)
        peak, share = np.maximum(found["peak"], self._least), cut / found["n"]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            seen = 1 - self._least / peak
            whole = np.where(seen >= _LEAST_SEEN, found["load"] / seen, np.nan)
            if not cut.any():
                return whole
            top = (peak / self._least**share) ** (1 / (1 - share))
            of_cut = found["n"] * top / np.log(top / self._least)
        return np.where(cut > 0, np.where(share <= _MOST_CUT, of_cut, np.nan), whole)

    def _frame_of(self, taxels: Whole, contact: Whole, load: Doubles, peak: Doubles) -> Whole:
        """(count,) the frame in which each contact has its largest value; -1 if no place is known."""
        placed = self._frame[taxels] >= 0
        if not placed.all():  # the largest value at a known place
            peak = np.full(len(peak), -1.0)
            np.maximum.at(peak, contact[placed], load[placed])
        is_largest = placed & (load == peak[contact])
        frame = np.full(len(peak), -1)
        frame[contact[is_largest]] = self._frame[taxels[is_largest]]
        return frame


def _largest(taxels: Whole, contact: Whole, load: Doubles, count: int, listed: Flags) -> tuple[Whole, Whole, Doubles]:
    """Those of the largest contacts; one that was listed stays unless another is clearly larger."""
    loads = np.bincount(contact, load, count)
    loads *= np.where(np.bincount(contact, listed, count) > 0, _CLEARLY, 1.0)
    kept = np.sort(np.argsort(-loads, kind="stable")[:MOST])
    number = np.full(count, -1)
    number[kept] = np.arange(MOST)
    number = number[contact]
    is_kept = number >= 0
    return taxels[is_kept], number[is_kept], load[is_kept]
