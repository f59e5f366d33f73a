"""The data path of drivers in C, and the tables that Python compiles for it (decision 0028)."""

from __future__ import annotations

from pathlib import Path

import skinware.native

ABI = 9
"""Number of the interface of ``path.c``; both change together."""

_FILE = Path(__file__).with_name("libskinware_drivers.so")


def library() -> skinware.native.Library:
    """Return the library of the data path."""
    return skinware.native.load(_FILE, ABI)
