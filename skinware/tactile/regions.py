"""Regions: named sets of taxels, whatever drivers there are and in whatever order.

Their file is TOML (:mod:`skinware.tactile.region_files`)::

    format = "skinware-regions"
    version = 1

    [[region]]
    name = "palm"
    type = "pressure"                   # of its sensors; left out: of all types
    driver = ["left_hand"]              # only of these; left out: of all drivers
    patch = ["board 14"]                # names of patches,
    module = ["board 15, triangle 3"]   # names of modules,
    uid = [0x100500, 0x100501]          # uid of sensors,
    frame = ["left_palm"]               # coordinate frames of places,
    box = [{ frame = "left_palm", centre_m = [0.0, 0.01, 0.0], size_m = [0.02, 0.02, 0.01] }]
    regions = ["thumb"]                 # and whole regions: what any of these says is in it,
    without = ["fingertips"]            # but for what is in these

As arrays, for a skin as it is now::

    regions = read_regions("skin/regions.toml")
    palm = regions.of(snapshot.layout, "pressure")["palm"]  # slice or (m,) int64
    snapshot.physical("pressure")[palm].max()

A patch or a frame that the skin does not have (now) adds nothing to a region: its driver may not be running.
"""

from __future__ import annotations

import graphlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from skinware._columns import Index, as_index, texts
from skinware.errors import ConfigurationError
from skinware.geometry import Triple
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure

_SELECTORS = ("uid", "patch", "module", "frame", "box", "regions")
Flags = npt.NDArray[np.bool_]


class Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box along the axes of a coordinate frame.

    Attributes:
        frame: name of the coordinate frame.
        centre_m: of the box, m.
        size_m: from side to side along each axis, m.
    """

    frame: str
    centre_m: Triple
    size_m: Triple

    def __post_init__(self) -> None:
        if not (np.isfinite(self.centre_m).all() and np.isfinite(self.size_m).all() and min(self.size_m) > 0):
            raise ValueError(
                f"a box at {list(self.centre_m)} of {list(self.size_m)}: give finite numbers, sizes above 0"
            )


class Region(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is in one region: what any of the selectors says, but for what is in ``without``.

    Attributes:
        name: of the region.
        type: name of the type of its sensors; empty: of all.
        driver: names of drivers that it is limited to; empty: all.
        uid: of sensors.
        patch: names of patches.
        module: names of modules, each after that of its patch.
        frame: names of coordinate frames.
        box: boxes, in which sensors lie.
        regions: names of other regions.
        without: names of regions whose sensors are not in this one.
    """

    name: Annotated[str, msgspec.Meta(min_length=1)]
    type: str = ""
    driver: tuple[str, ...] = ()
    uid: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()
    patch: tuple[str, ...] = ()
    module: tuple[str, ...] = ()
    frame: tuple[str, ...] = ()
    box: tuple[Box, ...] = ()
    regions: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not any(getattr(self, selector) for selector in _SELECTORS):
            raise ValueError(f"region {self.name!r} says nothing of what is in it: give any of {', '.join(_SELECTORS)}")
        if self.uid and max(self.uid) >= 1 << 64:
            raise ValueError(f"region {self.name!r}: uid {max(self.uid):#x} has more than 64 bits")


class RegionIndex(dict[str, Index]):
    """By name of a region: where its m sensors are, a slice or (m,) int64, ascending. An unknown name is an error."""

    def __missing__(self, name: str) -> Index:
        raise ConfigurationError(f"no region {name!r}; there are: {', '.join(self) or 'none'}")


class Regions:
    """Regions that may refer to each other.

    Args:
        regions: in any order.
        places: of each, where it stands, for messages.

    Raises:
        ConfigurationError: two of one name, a name that none has, one of another type, or a region that is in itself.
    """

    def __init__(self, regions: Iterable[Region], places: Sequence[str] = ()) -> None:
        self._regions = tuple(regions)
        self._in_turn = _in_turn(self._regions, [f"{place}: " for place in places] or [""] * len(self._regions))
        self._known: dict[str, tuple[SkinLayout | Structure, RegionIndex]] = {}

    def __iter__(self) -> Iterator[Region]:
        return iter(self._regions)

    def __len__(self) -> int:
        return len(self._regions)

    def of(self, skin: SkinLayout | Structure, type_name: str) -> RegionIndex:
        """Where the sensors of a type are, of every region that may have such sensors.

        It is computed once for a layout or structure, and given again as long as it is the same object.

        Args:
            skin: the layout of a whole skin (``snapshot.layout``), or the structure of one driver, for which limits to
                drivers do not count.
            type_name: type of sensors. Positions count in the order of ``snapshot.physical(type_name)``, or of
                ``structure.index(type_name)``.

        Raises:
            StructureError: the skin has no such sensors.
        """
        skin_then, found = self._known.get(type_name, (None, RegionIndex()))
        if skin_then is not skin:
            sensors, flags = _Sensors(skin, type_name), dict[str, Flags]()
            for region in self._in_turn:
                flags[region.name] = sensors.of(region, flags)
            of_type = [region.name for region in self._regions if region.type in ("", type_name)]
            found = RegionIndex({name: as_index(np.flatnonzero(flags[name])) for name in of_type})
            self._known[type_name] = skin, found
        return found


def _in_turn(regions: Sequence[Region], places: Sequence[str]) -> list[Region]:
    by_name: dict[str, Region] = {}
    place_of: dict[str, str] = {}
    for region, place in zip(regions, places, strict=True):
        if region.name in by_name:
            raise ConfigurationError(f"{place}there is another region {region.name!r}")
        by_name[region.name], place_of[region.name] = region, place
    for region, place in zip(regions, places, strict=True):
        for name in (*region.regions, *region.without):
            if name not in by_name:
                there_are = ", ".join(by_name)
                raise ConfigurationError(f"{place}region {region.name!r}: no region {name!r}; there are: {there_are}")
            types = {region.type, by_name[name].type} - {""}
            if len(types) > 1:
                text = f"is of {region.type} sensors, but {name!r} of {by_name[name].type} sensors"
                raise ConfigurationError(f"{place}region {region.name!r} {text}")
    try:
        order = graphlib.TopologicalSorter({r.name: (*r.regions, *r.without) for r in regions}).static_order()
        return [by_name[name] for name in order]
    except graphlib.CycleError as error:
        circle = error.args[1]
        names = " in ".join(map(repr, circle))
        raise ConfigurationError(f"{place_of[circle[-1]]}a region that is in itself: {names}") from None


class _Sensors:
    """The n sensors of one type of a skin, by all that regions may ask for.

    Args:
        skin: whose.
        type_name: which.
    """

    def __init__(self, skin: SkinLayout | Structure, type_name: str) -> None:
        self.layout = SkinLayout(("",), (skin,)) if isinstance(skin, Structure) else skin
        self.has_drivers = skin is self.layout
        self.type_name = type_name
        self.driver = self.layout.driver_of(type_name)
        self.uid = self.layout.uids(type_name)
        self.patch = self.layout.patch_of(type_name)
        self.module = self.layout.module_of(type_name)
        self.geometry = self.layout.geometry(type_name)
        structures = self.layout.structures
        own = [name for each in structures for name in zip(texts(each.patch_name), each.patch_names, strict=True)]
        self._patch_names = [{*names, name} for names, name in zip(own, self.layout.patches, strict=True)]
        own_modules = [name for each in structures for name in each.module_names]
        self._module_names = [set(names) for names in zip(own_modules, self.layout.modules, strict=True)]

    def of(self, region: Region, known: Mapping[str, Flags]) -> Flags:
        """(n,) bool: which are in a region, by what is known of those that it refers to."""
        layout, geometry = self.layout, self.geometry
        if region.type not in ("", self.type_name):
            return np.zeros(len(self.uid), bool)
        found = np.isin(self.uid, np.array(region.uid, np.uint64))
        found |= _named(self._patch_names, region.patch)[self.patch]
        found |= _named(self._module_names, region.module)[self.module]
        found |= np.isin(geometry.frame.astype(str), np.array(region.frame, str)) & geometry.known
        for box in region.box:
            inside = abs(geometry.position_m - box.centre_m) <= np.array(box.size_m) / 2
            found |= inside.all(axis=1) & (geometry.frame == box.frame)
        for name in region.regions:
            found |= known[name]
        if region.driver and self.has_drivers:
            found &= np.isin(np.array(layout.drivers, str), region.driver)[self.driver]
        for name in region.without:
            found &= ~known[name]
        return found


def _named(names: Sequence[set[str]], wanted: Sequence[str]) -> Flags:
    """Which patches or modules have one of the wanted names: that in the skin, or that of their driver alone."""
    return np.array([not each.isdisjoint(wanted) for each in names], bool)
