"""Packages of the extra ``convert``, imported when they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from skinware.errors import MissingExtra


def h5py() -> Any:
    """Return the package h5py, or raise MissingExtra."""
    return _package("h5py", "HDF5")


def pyarrow() -> Any:
    """Return the package pyarrow with its module ``parquet``, or raise MissingExtra."""
    _package("pyarrow.parquet", "Parquet")
    return _package("pyarrow", "Parquet")


def pillow() -> Any:
    """Return the module ``PIL.Image``, or raise MissingExtra."""
    return _package("PIL.Image", "a data set with images")


def _package(name: str, what: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise MissingExtra(f"{what} needs a package that is not installed: pip install 'skinware[convert]'") from None
