"""The data path of drivers in C, and the tables that Python compiles for it (decision 0028)."""

from __future__ import annotations

from pathlib import Path

import skinware.native

_HERE = Path(__file__).parent
_FILE = _HERE / "libskinware_drivers.so"

FOLDERS = (*skinware.native.FOLDERS, _HERE)
"""Folders of the headers that the library is compiled with."""


def library() -> skinware.native.Library:
    """Return the library of the data path."""
    return skinware.native.load(_FILE, FOLDERS)
