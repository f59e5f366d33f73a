"""An installation compiles both libraries, with a compiler that it asks for where the machine has none."""

from __future__ import annotations

import os
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.compiling import need_compiler
from tests.wheel import ROOT, built_wheel, copy_sources, run_in

LIBRARIES = {
    "skinware/native/libskinware.so",
    "skinware_drivers/native/libskinware_drivers.so",
}
BROKEN_COMPILER = {"CC": "/bin/false"}
HEADERS = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("skinware*/native/*.h")}
SOURCES = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("skinware*/native/*.c")} | HEADERS


@pytest.fixture
def compiler() -> None:
    need_compiler("cc")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    copy_sources(tmp_path / "source")
    return tmp_path / "source"


def libraries_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.glob("skinware*/native/*.so")}


def build(source: Path, *options: str, environ: Mapping[str, str] | None = None, succeeds: bool = True) -> str:
    command = "setup.py", "build_ext", "--build-lib", "built", *options
    return run_in(source, *command, environ=environ, succeeds=succeeds)


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without a compiler: the folder of its programs."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)
    return folder


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_a_wheel_has_the_libraries_with_their_headers_and_serves_every_python(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    wheel = built_wheel(tmp_path_factory)
    native_files = {name for name in zipfile.ZipFile(wheel).namelist() if "/native/" in name}
    assert {name for name in native_files if not name.endswith(".py")} == LIBRARIES | HEADERS
    assert wheel.name.partition("-py3-none-linux_")[1]


def hooks(source: Path) -> str:
    program = "import setup; print(setup.get_requires_for_build_wheel(), setup.get_requires_for_build_editable())"
    return run_in(source, "-c", program).splitlines()[-1]


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_a_build_asks_for_no_compiler_where_one_works(source: Path) -> None:
    assert "ziglang" not in hooks(source)


@pytest.mark.thorough
@pytest.mark.parametrize("reason", ["there is no compiler", "its headers are missing"])
def test_a_build_asks_for_a_compiler_where_none_works(source: Path, bare: Path, reason: str) -> None:
    if reason == "its headers are missing":
        (bare / "cc").write_text("#!/bin/sh\nexit 1\n")
        (bare / "cc").chmod(0o755)
    assert hooks(source).count("ziglang>=") == 2


@pytest.mark.thorough
@pytest.mark.usefixtures("bare")
def test_a_build_that_got_no_compiler_says_what_to_install(source: Path) -> None:
    output = build(source, succeeds=False)
    assert "no C compiler works here" in output
    assert "apt install gcc libc6-dev" in output


@pytest.mark.thorough
@pytest.mark.usefixtures("compiler")
def test_what_an_earlier_build_left_is_not_taken_for_the_new_one(source: Path) -> None:
    build(source)
    assert libraries_in(source / "built") == LIBRARIES
    assert "could not be compiled" in build(source, environ=BROKEN_COMPILER, succeeds=False)
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


@pytest.mark.thorough
def test_the_source_distribution_has_what_is_compiled(source: Path) -> None:
    run_in(source, "setup.py", "-q", "sdist")
    (archive,) = (source / "dist").iterdir()
    with tarfile.open(archive) as tar:
        there = {name.partition("/")[2] for name in tar.getnames()}
    assert SOURCES
    assert there >= SOURCES | {"setup.py", "pyproject.toml"}
