"""What an installation compiles, and that it is a whole one where nothing can be compiled."""

from __future__ import annotations

import os
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.compiling import need_compiler
from tests.outside.stranger import Stranger
from tests.wheel import NO_COMPILER, ROOT, built_wheel, copy_sources, make_wheel, run_in

LIBRARIES = {
    "skinware/native/libskinware.so",
    "skinware_drivers/native/libskinware_drivers.so",
}
SOURCES = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("skinware*/native/*.[ch]")}


@pytest.fixture
def compiler() -> None:
    need_compiler("cc")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    copy_sources(tmp_path / "source")
    return tmp_path / "source"


def libraries_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.glob("skinware*/native/*.so")}


def build(source: Path, *options: str, environ: Mapping[str, str] | None = None) -> str:
    return run_in(source, "setup.py", "build_ext", "--build-lib", "built", *options, environ=environ)


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_a_wheel_has_the_libraries_and_serves_every_python(tmp_path_factory: pytest.TempPathFactory) -> None:
    wheel = built_wheel(tmp_path_factory)
    native_files = {name for name in zipfile.ZipFile(wheel).namelist() if "/native/" in name}
    assert {name for name in native_files if not name.endswith(".py")} == LIBRARIES
    assert wheel.name.partition("-py3-none-linux_")[1]


@pytest.mark.parametrize("reason", ["there is no compiler", "it fails"])
def test_without_a_compiler_one_line_says_so(source: Path, tmp_path: Path, reason: str) -> None:
    (tmp_path / "bin").mkdir()
    environ = {"PATH": str(tmp_path / "bin")} if reason == "there is no compiler" else NO_COMPILER
    told = build(source, environ=environ)
    assert told.count("did not compile the native data path: Python runs instead") == 1
    assert "apt install gcc libc6-dev" in told
    assert not libraries_in(source / "built")


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_what_an_earlier_build_left_is_not_taken_for_the_new_one(source: Path) -> None:
    assert "did not compile" not in build(source)
    assert libraries_in(source / "built") == LIBRARIES
    build(source, environ=NO_COMPILER)
    assert not libraries_in(source / "built")


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_a_build_beside_the_sources_changes_no_library_that_is_in_use(source: Path) -> None:
    build(source, "--inplace")
    assert libraries_in(source) == LIBRARIES
    library = source / min(LIBRARIES)
    with library.open("rb") as in_use:
        build(source, "--inplace")
        assert libraries_in(source) == LIBRARIES
        assert not os.path.samestat(os.fstat(in_use.fileno()), library.stat())
    build(source, "--inplace", environ=NO_COMPILER)
    assert not libraries_in(source)


def test_the_source_distribution_has_what_is_compiled(source: Path) -> None:
    run_in(source, "setup.py", "-q", "sdist")
    (archive,) = (source / "dist").iterdir()
    with tarfile.open(archive) as tar:
        there = {name.partition("/")[2] for name in tar.getnames()}
    assert SOURCES
    assert there >= SOURCES | {"setup.py", "pyproject.toml"}


@pytest.mark.thorough
def test_an_installation_without_a_compiler_runs(source: Path, tmp_path: Path) -> None:
    wheel = make_wheel(source, tmp_path, NO_COMPILER)
    stranger = Stranger(tmp_path / "stranger", wheel, tmp_path / "mypy_cache")
    with stranger.running("skin-driver", "--bus", "virtual"):
        assert len(stranger.do("skin-dump", "-n", "3", "-T", "50", "--json").splitlines()) == 3
