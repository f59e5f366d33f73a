"""The package as others install it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.sharing import made_once

ROOT = Path(__file__).parent.parent
PATIENCE_S = 300.0


def built_wheel(factory: pytest.TempPathFactory) -> Path:
    """A wheel of this repository as it is now, made once in a run."""
    (wheel,) = made_once(factory, "wheel", _build_into).glob("*.whl")
    return wheel


def _build_into(folder: Path) -> None:
    source = folder / "source"
    source.mkdir()
    for part in ("skinware", "skinware_drivers"):
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for part in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / part, source)
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", *options, str(source)],
        check=True,
        timeout=PATIENCE_S,
        stdin=subprocess.DEVNULL,
    )
