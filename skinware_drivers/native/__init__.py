"""The data path in C, and how Python hands it what a layout compiles to (docs/decisions/0028-native-data-path.md)."""

from __future__ import annotations

from pathlib import Path

import skinware.native

ABI = 7
"""Of ``path.c``: both change together."""

_FILE = Path(__file__).with_name("libskinware_drivers.so")


def library() -> skinware.native.Library | None:
    """The data path in C, None where numpy does its work."""
    return skinware.native.load(_FILE, ABI).library


def why_python() -> str:
    """Why numpy does its work; empty if it does not."""
    return skinware.native.load(_FILE, ABI).why_python


__all__ = ["ABI", "library", "why_python"]
