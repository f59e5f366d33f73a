"""Compiles the native data path, where a C compiler is. All else that setuptools needs is in pyproject.toml.

Every package with C sources in its folder ``native`` gets one shared library there. It is called through ctypes: it
needs no headers of Python, and one wheel of a platform serves every Python. ``CC``, ``CFLAGS`` and ``LDFLAGS`` count.
"""

import os
import shlex
import subprocess
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

COMPILER = [*shlex.split(os.environ.get("CC", "cc")), "-O2", "-std=c11", "-fPIC", "-shared", "-fvisibility=hidden"]
COMPILER += shlex.split(os.environ.get("CFLAGS", ""))
LINKER = shlex.split(os.environ.get("LDFLAGS", ""))
HEADERS = [str(header) for header in Path().glob("skinware*/native/*.h")]


def native(package: str) -> Extension:
    """What the C sources of a package make: optional, since all that it does is there in Python too."""
    sources = [str(source) for source in sorted(Path(package, "native").glob("*.c"))]
    return Extension(f"{package}.native.lib{package}", sources, depends=HEADERS, optional=True)


class SharedLibraries(build_ext):
    """Calls the compiler itself: distutils adds what modules of the Python that builds need."""

    def get_ext_filename(self, fullname: str) -> str:
        return fullname.replace(".", "/") + ".so"

    def build_extensions(self) -> None:
        for ext in self.extensions:  # of earlier builds
            Path(self.get_ext_fullpath(ext.name)).unlink(missing_ok=True)
        try:
            for ext in self.extensions:
                self.build_extension(ext)
        except (OSError, subprocess.CalledProcessError):
            self.warn(
                f"{COMPILER[0]} did not compile the native data path: Python runs instead. For the native one, "
                "install a C compiler (Debian and Ubuntu: apt install gcc libc6-dev), then install again"
            )

    def build_extension(self, ext: Extension) -> None:
        library = Path(self.get_ext_fullpath(ext.name))
        library.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([*COMPILER, "-o", str(library), *ext.sources, *LINKER], check=True)

    def copy_extensions_to_source(self) -> None:
        for ext in self.extensions:  # not written over: a running program has the earlier one mapped
            Path(ext.sources[0]).with_name(f"{ext.name.rpartition('.')[2]}.so").unlink(missing_ok=True)
        super().copy_extensions_to_source()


class WheelForEveryPython(bdist_wheel):
    """Of one platform."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[native("skinware"), native("skinware_drivers")],
    cmdclass={"build_ext": SharedLibraries, "bdist_wheel": WheelForEveryPython},
)
