"""What takes long to make is made once for all processes of pytest-xdist."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest


def common_folder(factory: pytest.TempPathFactory) -> Path:
    """A folder of this run that all its processes have."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder of a name, which the first that asks for it makes and fills; others wait until it is whole.

    Args:
        factory: of the test.
        name: of the folder: all that has influence on what is in it.
        make: fills a folder that is there and empty.
    """
    common = common_folder(factory)
    folder = common / name
    with open(common / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            draft = Path(tempfile.mkdtemp(dir=common))
            make(draft)
            draft.rename(folder)
    return folder
