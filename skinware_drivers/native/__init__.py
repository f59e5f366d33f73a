"""The data path of drivers in C, and how Python hands it what a layout compiles to (decision 0028)."""

from __future__ import annotations

from pathlib import Path

import skinware.native

ABI = 8
"""Number of the interface of ``path.c``: both change together."""

_FILE = Path(__file__).with_name("libskinware_drivers.so")


def library() -> skinware.native.Library:
    """Return the library of the data path.

    Raises:
        PlatformError: it cannot be loaded; the message says what to do.
    """
    return skinware.native.load(_FILE, ABI)
