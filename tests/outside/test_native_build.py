"""What an installation compiles, and that it is a whole one where nothing can be compiled."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.compiling import need_compiler
from tests.outside.stranger import Stranger
from tests.wheel import NO_COMPILER, ROOT, built_wheel, copy_sources, pip_in

LIBRARIES = {
    "skinware/native/libskinware.so",
    "skinware_drivers/native/libskinware_drivers.so",
}
SOURCES = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("skinware*/native/*.[ch]")}
TOLD = "did not compile the native data path: Python runs instead"


@pytest.fixture
def compiler() -> None:
    need_compiler("cc")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    copy_sources(tmp_path / "source")
    return tmp_path / "source"


def native_files(wheel: Path) -> set[str]:
    return {name for name in zipfile.ZipFile(wheel).namelist() if "/native/" in name and not name.endswith(".py")}


def libraries_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.glob("skinware*/native/*.so")}


def wheel_of(source: Path, **environ: str) -> tuple[Path, str]:
    told = pip_in(source, "wheel", "--no-deps", "--wheel-dir", str(source.parent), environ=environ)
    (wheel,) = source.parent.glob("*.whl")
    return wheel, told


@pytest.mark.usefixtures("compiler")
def test_a_wheel_has_the_libraries_and_serves_every_python(tmp_path_factory: pytest.TempPathFactory) -> None:
    wheel = built_wheel(tmp_path_factory)
    assert native_files(wheel) == LIBRARIES
    assert wheel.name.partition("-py3-none-linux_")[1]


@pytest.mark.parametrize("reason", ["there is no compiler", "it fails"])
def test_without_a_compiler_one_line_says_so(source: Path, tmp_path: Path, reason: str) -> None:
    (tmp_path / "bin").mkdir()
    environ = {"PATH": str(tmp_path / "bin")} if reason == "there is no compiler" else NO_COMPILER
    wheel, told = wheel_of(source, **environ)
    assert not native_files(wheel)
    assert told.count(TOLD) == 1
    assert "apt install gcc libc6-dev" in told


@pytest.mark.usefixtures("compiler")
def test_what_an_earlier_build_left_is_not_taken_for_the_new_one(source: Path) -> None:
    wheel, told = wheel_of(source)
    assert TOLD not in told
    assert native_files(wheel) == LIBRARIES
    assert any((source / "build").glob("lib*/skinware*/native/*.so"))
    wheel, _ = wheel_of(source, **NO_COMPILER)
    assert not native_files(wheel)


@pytest.mark.usefixtures("compiler")
def test_an_editable_installation_has_the_libraries_of_its_sources(source: Path, tmp_path: Path) -> None:
    options = ("--no-deps", "--target", str(tmp_path / "installed"), "--upgrade", "--editable")
    pip_in(source, "install", *options)
    assert libraries_in(source) == LIBRARIES
    library = source / min(LIBRARIES)
    with library.open("rb") as in_use:
        pip_in(source, "install", *options)
        assert libraries_in(source) == LIBRARIES
        assert not os.path.samestat(os.fstat(in_use.fileno()), library.stat())  # which must not change under it
    pip_in(source, "install", *options, environ=NO_COMPILER)
    assert not libraries_in(source)


def test_the_source_distribution_has_what_is_compiled(source: Path) -> None:
    subprocess.run([sys.executable, "setup.py", "-q", "sdist"], cwd=source, check=True, capture_output=True)
    (archive,) = (source / "dist").iterdir()
    with tarfile.open(archive) as tar:
        there = {name.partition("/")[2] for name in tar.getnames()}
    assert SOURCES
    assert there >= SOURCES | {"setup.py", "pyproject.toml"}


def test_an_installation_without_a_compiler_runs(source: Path, tmp_path: Path) -> None:
    wheel, _ = wheel_of(source, **NO_COMPILER)
    stranger = Stranger(tmp_path / "stranger", wheel, tmp_path / "mypy_cache")
    with stranger.running("skin-driver", "--bus", "virtual"):
        assert len(stranger.do("skin-dump", "-n", "3", "-T", "50", "--json").splitlines()) == 3
