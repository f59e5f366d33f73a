"""Skinware: real-time middleware for robot skin.

Read a skin without knowing its hardware::

    import skinware

    with skinware.Skin() as skin:
        for snapshot in skin:
            pressure = snapshot.physical("pressure")  # (n,) float32
"""

import os

from skinware import realtime, threads
from skinware.driver_service import DriverReader, DriverWriter
from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import Column, Schema, ServiceReader, ServiceWriter
from skinware.skin import Skin
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot, Window
from skinware.status import BusReason, BusState, PatchState, Status
from skinware.structure import Structure

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
    "Snapshot",
    "Status",
    "Structure",
    "Window",
    "get_include",
    "realtime",
    "threads",
]


def get_include() -> str:
    """Return the folder of ``skinware.h``, with which C and C++ programs read skins: ``cc -I"$(...)"``."""
    return os.path.join(os.path.dirname(__file__), "include")
