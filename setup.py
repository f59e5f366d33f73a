"""Compile the native libraries; all else that setuptools needs is in pyproject.toml.

Every package with C sources in its folder ``native`` gets one shared library there, which is called through ctypes: it
needs no headers of Python, and one wheel of a platform serves every Python. ``CC``, ``CFLAGS`` and ``LDFLAGS`` count.

pyproject.toml names this file as its build backend as well: where no C compiler works, it asks for the package
``ziglang``, which brings one (docs/decisions/0051-compiled-everywhere.md).
"""

import importlib.util
import os
import shlex
import subprocess
import sys
import tempfile
import zlib
from functools import cache
from pathlib import Path

from setuptools import Extension, build_meta, setup
from setuptools.build_meta import *  # noqa: F403
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

OPTIONS = ["-O3", "-std=c11", "-fPIC", "-shared", "-fvisibility=hidden"]
OPTIONS += ["-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]  # loops over taxels
OPTIONS += shlex.split(os.environ.get("CFLAGS", ""))
LINKER = ["-lm", *shlex.split(os.environ.get("LDFLAGS", ""))]
CORE = ["skinware/include", "skinware/native"]
HEADERS = {"skinware": CORE, "skinware_drivers": [*CORE, "skinware_drivers/native"]}
ZIG = [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
PROBE = "#include <sys/epoll.h>\nint probe(void);\nint probe(void) { return EPOLLIN; }\n"
MISSING = (
    "no C compiler works here, and skinware cannot run without its compiled libraries: install one (Debian and Ubuntu:"
    " apt install gcc libc6-dev) or the package ziglang, then install again"
)


def get_requires_for_build_wheel(config_settings=None):
    return build_meta.get_requires_for_build_wheel(config_settings) + missing_compiler()


def get_requires_for_build_editable(config_settings=None):
    return build_meta.get_requires_for_build_editable(config_settings) + missing_compiler()


def missing_compiler() -> list[str]:
    return [] if "CC" in os.environ or works("cc") else ["ziglang>=0.17"]


@cache
def works(compiler: str) -> bool:
    """Compile a few lines: a compiler may be there without the headers of the C library."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.c")
        source.write_text(PROBE)
        command = [compiler, *OPTIONS, "-o", str(source.with_suffix(".so")), str(source)]
        try:
            return subprocess.run(command, capture_output=True).returncode == 0
        except OSError:
            return False


def compiler() -> list[str]:
    if "CC" in os.environ:
        return shlex.split(os.environ["CC"])
    if works("cc"):
        return ["cc"]
    if importlib.util.find_spec("ziglang") is None:
        raise SystemExit(MISSING)
    return ZIG


def native(package: str) -> Extension:
    sources = [str(source) for source in sorted(Path(package, "native").glob("*.c"))]
    headers = [header for folder in HEADERS[package] for header in sorted(Path(folder).glob("*.h"))]
    checksum = zlib.crc32(b"".join(header.read_bytes() for header in headers))
    macros = [("SKINWARE_HEADERS", f"{checksum}u")]  # skinware.native compares it before it calls the library
    return Extension(
        f"{package}.native.lib{package}", sources, depends=[str(header) for header in headers], define_macros=macros
    )


class SharedLibraries(build_ext):
    """Calls the compiler itself: distutils adds what modules of the Python that builds need."""

    def get_ext_filename(self, fullname: str) -> str:
        return fullname.replace(".", "/") + ".so"

    def build_extensions(self) -> None:
        for ext in self.extensions:  # of earlier builds
            Path(self.get_ext_fullpath(ext.name)).unlink(missing_ok=True)
        for ext in self.extensions:
            self.build_extension(ext)

    def build_extension(self, ext: Extension) -> None:
        library = Path(self.get_ext_fullpath(ext.name))
        library.parent.mkdir(parents=True, exist_ok=True)
        macros = [f"-D{name}={value}" for name, value in ext.define_macros]
        command = [*compiler(), *OPTIONS, *macros, "-o", str(library), *ext.sources, *LINKER]
        try:
            subprocess.run(command, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise SystemExit(f"{library.name} could not be compiled: {error}") from error

    def copy_extensions_to_source(self) -> None:
        for ext in self.extensions:  # not written over: a running program has the earlier one mapped
            Path(ext.sources[0]).with_name(f"{ext.name.rpartition('.')[2]}.so").unlink(missing_ok=True)
        super().copy_extensions_to_source()


class WheelForEveryPython(bdist_wheel):
    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


if __name__ == "__main__":
    setup(
        ext_modules=[native("skinware"), native("skinware_drivers")],
        cmdclass={"build_ext": SharedLibraries, "bdist_wheel": WheelForEveryPython},
    )
