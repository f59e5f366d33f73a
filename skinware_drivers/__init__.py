"""The names that an author of drivers needs; more are in ``.can``, ``.serial``, ``.modbus`` and ``.virtual``."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skinware_drivers.bus import EXTENDED_FLAG
    from skinware_drivers.decoding.decoder import Updates
    from skinware_drivers.description import Module, Patch, Sensor, taxels
    from skinware_drivers.fields import (
        Above,
        Bits,
        Byte,
        DeviceTime,
        Flag,
        Identifier,
        Match,
        Packed,
        Sentinel,
        SequenceNumber,
        StatusBytes,
    )
    from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values
    from skinware_drivers.link import Link
    from skinware_drivers.operations import operation
    from skinware_drivers.options import NoOptions, Options
    from skinware_drivers.polling import Notice, Poll, Watch

__all__ = [
    "EXTENDED_FLAG",
    "Above",
    "Bits",
    "Byte",
    "Cycle",
    "DeviceTime",
    "Expand",
    "Flag",
    "Frame",
    "Identifier",
    "Layout",
    "Link",
    "Match",
    "Module",
    "NoOptions",
    "Notice",
    "Options",
    "Packed",
    "Patch",
    "Poll",
    "Sensor",
    "Sentinel",
    "SequenceNumber",
    "StatusBytes",
    "Updates",
    "Values",
    "Watch",
    "get_include",
    "operation",
    "taxels",
]

_MODULES = ("fields", "layout", "bus", "description", "link", "operations", "options", "polling")


def get_include() -> str:
    """The folder of ``openpatch.h``, the microcontroller's side of the open patch protocol."""
    return os.path.join(os.path.dirname(__file__), "include")


def __getattr__(name: str) -> Any:
    """Import what is asked for, and no more: commands and the pytest plug-in, which are here too, start fast."""
    if name in __all__:
        for module in map(importlib.import_module, (f"{__name__}.{module}" for module in _MODULES)):
            if name in vars(module):
                return vars(module)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, too, although most are not imported yet: for completion."""
    return sorted({*globals(), *__all__})
