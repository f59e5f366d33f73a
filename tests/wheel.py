"""The package as others install it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.sharing import made_once

ROOT = Path(__file__).parent.parent
NO_COMPILER = {"CC": "/bin/false"}
PATIENCE_S = 300.0


def built_wheel(factory: pytest.TempPathFactory) -> Path:
    """A wheel of this repository as it is now, made once in a run."""
    (wheel,) = made_once(factory, "wheel", _build_into).glob("*.whl")
    return wheel


def _build_into(folder: Path) -> None:
    source = folder / "source"
    copy_sources(source)
    pip_in(source, "wheel", "--no-deps", "--wheel-dir", str(folder))


def copy_sources(folder: Path) -> None:
    """All that a wheel is built from, into a new folder."""
    folder.mkdir()
    for part in ("skinware", "skinware_drivers"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for part in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / part, folder)


def pip_in(source: Path, command: str, *options: str, environ: Mapping[str, str] | None = None) -> str:
    """Run pip with the package of a folder, and no network; what it said. It must succeed.

    Args:
        source: the folder.
        command: of pip, such as ``wheel``.
        options: more of them.
        environ: environment beside what is there.
    """
    done = subprocess.run(
        [sys.executable, "-m", "pip", "-v", command, "--no-index", "--no-build-isolation", *options, str(source)],
        env={**os.environ, **(environ or {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=PATIENCE_S,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout
