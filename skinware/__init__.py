"""Skinware: real-time middleware for robot skin.

Read a skin without knowing its hardware::

    import skinware

    with skinware.Skin() as skin:
        for snapshot in skin:
            pressure = snapshot.physical("pressure")  # (n,) float32
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from skinware import realtime, threads
from skinware.driver_service import DriverReader, DriverWriter
from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.moments import SkinMoment, TimedRows, TimeWindow
from skinware.service import Column, Schema, ServiceReader, ServiceWriter
from skinware.skin import Skin
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot, Window
from skinware.status import BusReason, BusState, PatchState, Status
from skinware.structure import Structure

if TYPE_CHECKING:
    from skinware.views.notebook import View

__all__ = [
    "BusReason",
    "BusState",
    "Column",
    "DriverReader",
    "DriverSnapshot",
    "DriverWriter",
    "Namespace",
    "PatchState",
    "Sample",
    "Schema",
    "ServiceReader",
    "ServiceWriter",
    "Skin",
    "SkinLayout",
    "SkinMoment",
    "Snapshot",
    "Status",
    "Structure",
    "TimeWindow",
    "TimedRows",
    "Window",
    "get_include",
    "realtime",
    "threads",
    "view",
]


def get_include() -> str:
    """Return the folder of ``skinware.h``, with which C and C++ programs read skins: ``cc -I"$(...)"``."""
    return os.path.join(os.path.dirname(__file__), "include")


def view(*names: "str | Path", namespace: Namespace | str | None = None, height: int = 600) -> "View":
    """Return the page of ``skin-view``, which shows itself as the last value of a notebook's cell.

    Args:
        names: of drivers, or files of recordings (``.mcap``); none: all drivers.
        namespace: of the drivers; default: the one of ``SKINWARE_NAMESPACE``.
        height: of the page in a notebook, pixels.

    Raises:
        MissingExtra: the packages of the extra ``view`` are not installed.
        OSError: there is no free port.
    """
    from skinware.views.notebook import View

    return View(*names, namespace=namespace, height=height)
