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
PATIENCE_S = 300.0


def built_wheel(factory: pytest.TempPathFactory) -> Path:
    """A wheel of this repository as it is now, made once in a run."""
    (wheel,) = made_once(factory, "wheel", _build_into).glob("*.whl")
    return wheel


def _build_into(folder: Path) -> None:
    source = folder / "source"
    copy_sources(source)
    make_wheel(source, folder)


def copy_sources(folder: Path) -> None:
    """All that a wheel is built from, into a new folder."""
    folder.mkdir()
    for part in ("skinware", "skinware_drivers", "skinware_start"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for part in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / part, folder)


def make_wheel(source: Path, folder: Path, environ: Mapping[str, str] | None = None) -> Path:
    """The wheel of copied sources.

    Args:
        source: the copy.
        folder: for the wheel.
        environ: environment beside what is there.
    """
    options = ["--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    run_in(source, "-m", "pip", "wheel", *options, ".", environ=environ)
    (wheel,) = folder.glob("*.whl")
    return wheel


def run_in(source: Path, *arguments: str, environ: Mapping[str, str] | None = None, succeeds: bool = True) -> str:
    """Run Python with copied sources, and a compiler that does not optimize; return its output.

    Args:
        source: the copy.
        arguments: of Python.
        environ: environment beside what is there.
        succeeds: whether it must exit with 0 or with another status.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=source,
        env={**os.environ, "CFLAGS": "-O0", **(environ or {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=PATIENCE_S,
        text=True,
    )
    assert (done.returncode == 0) == succeeds, done.stdout
    return done.stdout
