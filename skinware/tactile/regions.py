"""Define regions, named sets of taxels; choose sensors by them; read and write their files."""

from __future__ import annotations

import graphlib
import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from skinware._columns import Index, as_index, texts
from skinware.errors import ConfigurationError
from skinware.geometry import Triple
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.arrays import Flags
from skinware.toml_text import TomlText, line_of

_SELECTORS = ("uid", "patch", "module", "frame", "box", "regions")


class Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box along the axes of a coordinate frame.

    Attributes:
        frame: name of the coordinate frame.
        centre_m: centre of the box, m.
        size_m: length of each side, m.
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
    """One region: the sensors that any of its selectors names, except for those in ``without``.

    Attributes:
        name: name of the region.
        type: name of the type of its sensors; empty: all types.
        driver: names of the drivers that it is limited to; empty: all.
        uid: uids of sensors.
        patch: names of patches.
        module: names of modules, each after that of its patch.
        frame: names of coordinate frames.
        box: boxes around sensors.
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
            raise ValueError(f"region {self.name!r} selects nothing: give any of {', '.join(_SELECTORS)}")
        if self.uid and max(self.uid) >= 1 << 64:
            raise ValueError(f"region {self.name!r}: uid {max(self.uid):#x} has more than 64 bits")


class RegionIndex(dict[str, Index]):
    """The positions of the sensors of each region, by its name: a slice or (m,) int64, ascending."""

    def __missing__(self, name: str) -> Index:
        raise ConfigurationError(f"no region {name!r}; there are: {', '.join(self) or 'none'}")


class Regions:
    """Regions that may refer to each other.

    Args:
        regions: the regions, in any order.
        places: file and line of each, for messages.

    Raises:
        ConfigurationError: a name twice, an unknown name, a region of another type, or a region in itself.
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
        """Return the positions of the sensors of a type, for every region that may have such sensors.

        Positions count in the order of ``snapshot.physical(type_name)`` of a whole skin (``snapshot.layout``), or of
        ``structure.index(type_name)`` of one driver, for which limits to drivers do not count. The result is computed
        once for each layout or structure.

        Raises:
            StructureError: the skin has no such sensors.
        """
        skin_then, found = self._known.get(type_name, (None, RegionIndex()))
        if skin_then is not skin:
            flags = _members(skin, type_name, self._in_turn)
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
        raise ConfigurationError(f"{place_of[circle[-1]]}a region is in itself: {names}") from None


def _members(skin: SkinLayout | Structure, type_name: str, regions: Iterable[Region]) -> dict[str, Flags]:
    """By name, (n,) bool: the sensors of a type in each region, after the regions that it refers to."""
    layout = SkinLayout(("",), (skin,)) if isinstance(skin, Structure) else skin
    driver, uid, geometry = layout.driver_of(type_name), layout.uids(type_name), layout.geometry(type_name)
    patch, module = layout.patch_of(type_name), layout.module_of(type_name)
    own = [name for each in layout.structures for name in zip(texts(each.patch_name), each.patch_names, strict=True)]
    patch_names = [{*names, name} for names, name in zip(own, layout.patches, strict=True)]
    own_modules = [name for each in layout.structures for name in each.module_names]
    module_names = [set(names) for names in zip(own_modules, layout.modules, strict=True)]
    members: dict[str, Flags] = {}
    for region in regions:
        if region.type not in ("", type_name):
            members[region.name] = np.zeros(len(uid), bool)
            continue
        found = np.isin(uid, np.array(region.uid, np.uint64))
        found |= _named(patch_names, region.patch)[patch]
        found |= _named(module_names, region.module)[module]
        found |= np.isin(geometry.frame.astype(str), np.array(region.frame, str)) & geometry.known
        for box in region.box:
            inside = abs(geometry.position_m - box.centre_m) <= np.array(box.size_m) / 2
            found |= inside.all(axis=1) & (geometry.frame == box.frame)
        for name in region.regions:
            found |= members[name]
        if region.driver and skin is layout:
            found &= np.isin(np.array(layout.drivers, str), region.driver)[driver]
        for name in region.without:
            found &= ~members[name]
        members[region.name] = found
    return members


def _named(names: Sequence[set[str]], wanted: Sequence[str]) -> Flags:
    return np.array([not each.isdisjoint(wanted) for each in names], bool)


@dataclass(frozen=True)
class SensorChoice:
    """A choice of sensors: those to which all conditions apply; an empty one applies to all.

    Attributes:
        types, patches: names of sensor types, and of patches.
        regions: the regions that ``in_regions`` refers to.
        in_regions: names of regions; a sensor is in any of them.
    """

    types: Collection[str] = ()
    patches: Collection[str] = ()
    regions: Regions = field(default_factory=lambda: Regions(()))
    in_regions: Collection[str] = ()

    def __bool__(self) -> bool:
        return bool(self.types or self.patches or self.in_regions)

    def unknown(self, structures: Sequence[Structure]) -> Iterator[str]:
        """Yield a line for each name that does not exist in the structures of all drivers."""
        yield from unknown("sensor type", self.types, [each.name for one in structures for each in one.types])
        yield from unknown("patch", self.patches, [name for one in structures for name in one.patch_names])
        yield from unknown("region", self.in_regions, [region.name for region in self.regions])

    def of(self, driver: str, structure: Structure) -> Flags:
        """Return (n_sensors,) bool: the chosen sensors of a driver, in the order of its samples."""
        wanted, layout = np.zeros(structure.n_sensors, bool), SkinLayout((driver,), (structure,))
        for name in [each.name for each in structure.types if not self.types or each.name in self.types]:
            inside = np.full(len(structure.module_of(name)), not self.in_regions)
            if self.in_regions and len(inside):
                found = self.regions.of(layout, name)
                for region in self.in_regions:
                    if region in found:  # others are of sensors of other types
                        inside[found[region]] = True
            wanted[structure.index(name)] = inside
        if self.patches:
            numbers = [row for row, name in enumerate(structure.patch_names) if name in self.patches]
            wanted &= np.isin(structure.sensor_patch, numbers)
        return wanted


def unknown(what: str, wanted: Collection[str], there_are: Sequence[str]) -> Iterator[str]:
    """Yield a line for each name that does not exist: ``no patch 'palm'; there are: board 7, board 8``."""
    for name in wanted:
        if name not in there_are:
            yield f"no {what} {name!r}; there are: {', '.join(dict.fromkeys(there_are)) or 'none'}"


FORMAT, VERSION = "skinware-regions", 1

_UIDS_IN_A_LINE = 8


def read_regions(*paths: str | Path) -> Regions:
    """Read files of regions, which together are one set.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, a wrong value, or as for :class:`Regions`; the
            message says where.
    """
    regions: list[Region] = []
    places: list[str] = []
    for path in paths:
        text = TomlText(Path(path))
        found: tuple[Region, ...] = text.entries("file of regions", FORMAT, VERSION, "region", Region)
        places += [text.place(("region", number)) for number in range(len(found))]
        regions += found
    return Regions(regions, places)


def regions_to_toml(regions: Iterable[Region], comment: str = "") -> str:
    """Return the text of a file of regions, with the lines of a comment at its head."""
    lines = [*(f"# {line}".rstrip() for line in comment.splitlines()), f'format = "{FORMAT}"', f"version = {VERSION}"]
    return "\n".join(lines) + "\n" + "".join(f"\n{_region_text(region)}" for region in regions)


def put_region(path: str | Path, region: Region, *, replace: bool = False) -> None:
    """Write a region into a file, which is created if necessary; everything else in it stays.

    Raises:
        ConfigurationError: it is no file of regions, would be wrong with this region, or has one of this name, which is
            not to be replaced.
        OSError: it cannot be written.
    """
    path = Path(path)
    text = regions_to_toml([])
    names: list[str] = []
    if path.exists():
        names = [known.name for known in read_regions(path)]
        text = path.read_text(encoding="utf-8")
    if region.name not in names:
        text = f"{text.rstrip()}\n\n{_region_text(region)}"
    elif replace:
        text = _replaced(path, text, names.index(region.name), region)
    else:
        raise ConfigurationError(f"{path}: there is a region {region.name!r} already")
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        draft.write_text(text, encoding="utf-8")
        read_regions(draft)
        draft.replace(path)
    except ConfigurationError as error:
        raise ConfigurationError(str(error).replace(str(draft), str(path))) from None
    finally:
        draft.unlink(missing_ok=True)


def _replaced(path: Path, text: str, number: int, region: Region) -> str:
    """The text of a file with another region in the place of one of its regions; comments between regions stay."""
    lines = text.splitlines(keepends=True)
    begin, end = (line_of(text, ("region", each)) - 1 for each in (number, number + 1))
    if not lines[begin].lstrip().startswith("["):
        raise ConfigurationError(f"{path}:{begin + 1}: regions in one value: replace {region.name!r} by hand")
    if end <= begin:  # it is the last one
        end = len(lines)
    while lines[end - 1].strip() == "" or lines[end - 1].lstrip().startswith("#"):
        end -= 1
    return "".join([*lines[:begin], _region_text(region), *lines[end:]])


def _region_text(region: Region) -> str:
    given = {name: value for name in region.__struct_fields__ if (value := getattr(region, name))}
    return "[[region]]\n" + "".join(f"{name} = {_value(value, name)}\n" for name, value in given.items())


def _value(value: Any, name: str) -> str:
    if isinstance(value, tuple):
        rows = [_value(row, name) for row in value]
        if len(rows) > _UIDS_IN_A_LINE and name == "uid":
            parts = [rows[first : first + _UIDS_IN_A_LINE] for first in range(0, len(rows), _UIDS_IN_A_LINE)]
            return "[\n" + "".join(f"  {', '.join(part)},\n" for part in parts) + "]"
        return f"[{', '.join(rows)}]"
    if isinstance(value, Box):
        pairs = ((key, getattr(value, key)) for key in value.__struct_fields__)
        return f"{{ {', '.join(f'{key} = {_value(inner, key)}' for key, inner in pairs)} }}"
    if isinstance(value, int | float):
        return f"{value:#x}" if name == "uid" else repr(float(value))
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
