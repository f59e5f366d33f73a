"""Files of regions: read, and written by programs without touching what people wrote in them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.tactile.regions import Box, Region, Regions
from skinware.toml_text import TomlText, line_of

FORMAT, VERSION = "skinware-regions", 1

_UIDS_IN_A_LINE = 8


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    region: tuple[Region, ...] = ()


def read_regions(*paths: str | Path) -> Regions:
    """Read files of regions, which together are one set.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, a value that is wrong, or as for :class:`Regions`;
            the message says where.
    """
    regions: list[Region] = []
    places: list[str] = []
    for path in paths:
        text = TomlText(Path(path))
        found = text.of_format("file of regions", FORMAT, VERSION, _File).region
        places += [text.place(("region", number)) for number in range(len(found))]
        regions += found
    return Regions(regions, places)


def regions_to_toml(regions: Iterable[Region], comment: str = "") -> str:
    """The text of a file of regions.

    Args:
        regions: what is in it.
        comment: lines for its head.
    """
    lines = [*(f"# {line}".rstrip() for line in comment.splitlines()), f'format = "{FORMAT}"', f"version = {VERSION}"]
    return "\n".join(lines) + "\n" + "".join(f"\n{_region_text(region)}" for region in regions)


def put_region(path: str | Path, region: Region, *, replace: bool = False) -> None:
    """Write a region into a file, which is made if it is not there; all else in it stays as it is.

    Args:
        path: of the file.
        region: to be written.
        replace: where the file has a region of this name, this one takes its place.

    Raises:
        ConfigurationError: the file is none of regions, has a region of this name, or would be wrong with this one.
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
    """A file's text with another region in the place of one of its regions; comments between regions stay."""
    lines = text.splitlines(keepends=True)
    begin, end = (line_of(text, ("region", each)) - 1 for each in (number, number + 1))
    if not lines[begin].lstrip().startswith("["):
        raise ConfigurationError(f"{path}:{begin + 1}: regions in one value: replace {region.name!r} by hand")
    if end <= begin:  # there is none after it
        end = len(lines)
    while lines[end - 1].strip() == "" or lines[end - 1].lstrip().startswith("#"):
        end -= 1
    return "".join([*lines[:begin], _region_text(region), *lines[end:]])


def _region_text(region: Region) -> str:
    lines = ["[[region]]"]
    for field in msgspec.structs.fields(region):
        value = getattr(region, field.name)
        if value:
            lines.append(f"{field.name} = {_value(value, field.name)}")
    return "\n".join(lines) + "\n"


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
