"""The text of a configuration file, as a person would write it: only what is not the default, one table a line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import msgspec.structs

from skinware_drivers.icub.translate import TranslatedBus
from skinware_drivers.streams.yarp import YarpOptions

_HEXADECIMAL = ("cdc_offset", "no_load")
_ALWAYS = ("boards", "period_ms", "skin_type", "no_load", "shift", "cdc_offset", "enabled", "values")
"""Options that are written although they are the default."""
_TABLES = ("special_boards", "modules", "triangles")


def configuration_text(name: str, buses: Sequence[TranslatedBus], comment: str, geometry: str = "") -> str:
    """What ``skin-driver --config`` reads.

    Args:
        name: of the skin.
        buses: of the part.
        comment: lines for its head.
        geometry: file beside it with the places of the sensors.
    """
    each = [(bus.name, bus.comment, bus.options) for bus in buses]
    return _text("roboskin", name, each, comment, geometry)


def yarp_configuration_text(
    name: str, buses: Sequence[tuple[str, YarpOptions]], comment: str, geometry: str = ""
) -> str:
    """The same for the driver ``yarp``.

    Args:
        name: of the skin.
        buses: name and options of each port.
        comment: lines for its head.
        geometry: file beside it with the places of the sensors.
    """
    return _text("yarp", name, [(bus, "", options) for bus, options in buses], comment, geometry)


def _text(driver: str, name: str, buses: Sequence[tuple[str, str, msgspec.Struct]], comment: str, geometry: str) -> str:
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [f"driver = {_value(driver)}", f"name = {_value(name)}"]
    lines += [f"geometry = {_value(geometry)}"] if geometry else []
    for bus, to_fill_in, options in buses:
        lines += ["", "[[bus]]", f"name = {_value(bus)}" + (f"  # {to_fill_in}" if to_fill_in else "")]
        lines += ["[bus.options]", *_option_lines(options)]
    return "\n".join(lines) + "\n"


def _option_lines(options: msgspec.Struct) -> list[str]:
    lines = []
    for field in msgspec.structs.fields(options):
        value = getattr(options, field.name)
        if field.name not in _ALWAYS and value == field.default:
            continue
        if field.name in _TABLES:
            lines += [f"{field.name} = [", *(f"  {_table(row)}," for row in value), "]"]
        else:
            lines.append(f"{field.name} = {_value(value, field.name)}")
    return lines


def _table(row: msgspec.Struct) -> str:
    pairs = [
        f"{field.name} = {_value(getattr(row, field.name), field.name)}"
        for field in msgspec.structs.fields(row)
        if field.required or getattr(row, field.name) != field.default
    ]
    return f"{{ {', '.join(pairs)} }}"


def _value(value: Any, name: str = "") -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value:#x}" if name in _HEXADECIMAL else str(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_value(item) for item in value)}]"
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
