"""The text of a configuration file, as a person would write it: only what is not the default, one table a line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import msgspec.structs

from skinware_drivers.can.roboskin_options import RoboskinOptions
from skinware_drivers.icub.translate import TranslatedBus

_HEXADECIMAL = ("cdc_offset", "no_load")


def configuration_text(name: str, buses: Sequence[TranslatedBus], comment: str, geometry: str = "") -> str:
    """What ``skin-driver --config`` reads.

    Args:
        name: of the skin.
        buses: of the part.
        comment: lines for its head.
        geometry: file beside it with the places of the sensors.
    """
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += ['driver = "roboskin"', f"name = {_value(name)}"]
    lines += [f"geometry = {_value(geometry)}"] if geometry else []
    for bus in buses:
        lines += ["", "[[bus]]", f"name = {_value(bus.name)}" + (f"  # {bus.comment}" if bus.comment else "")]
        lines += ["[bus.options]", *_option_lines(bus.options)]
    return "\n".join(lines) + "\n"


def _option_lines(options: RoboskinOptions) -> list[str]:
    always = ("boards", "period_ms", "skin_type", "no_load", "shift", "cdc_offset", "enabled")
    lines = []
    for field in msgspec.structs.fields(options):
        value = getattr(options, field.name)
        if field.name not in always and value == field.default:
            continue
        if field.name in ("special_boards", "modules"):
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


__all__ = ["configuration_text"]
