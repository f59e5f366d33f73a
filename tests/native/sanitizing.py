"""The data path compiled with sanitizers, and an environment in which Python can call it.

The sanitizers' runtime has to be there before all else, and all memory of Python has to be its own: it then stops the
process as soon as C reads or writes one byte beside what numpy handed over, or does what C leaves undefined.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import skinware.native
import skinware_drivers.native
from tests.compiling import need_compiler

COMPILER = "gcc"
LIBRARY = "SKINWARE_TEST_LIBRARY"
"""Environment variable: the library to be tested instead of the one that was installed."""
_OPTIONS = (
    *("-std=c11", "-O1", "-g", "-fPIC", "-shared", "-fvisibility=hidden", "-fno-omit-frame-pointer"),
    *("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fsanitize-coverage=trace-pc"),
)
_HERE = Path(__file__).parent


def compile_sanitized(folder: Path) -> Path:
    """The library, in this folder; needs a compiler."""
    need_compiler(COMPILER)
    library, coverage = folder / "libskinware_drivers.so", folder / "coverage.o"
    subprocess.run([COMPILER, "-O2", "-fPIC", "-c", "-o", coverage, _HERE / "coverage.c"], check=True)
    sources = sorted((Path(skinware_drivers.__file__).parent / "native").glob("*.c"))
    headers = f"-DSKINWARE_HEADERS={skinware.native.checksum(skinware_drivers.native.FOLDERS)}u"
    subprocess.run([COMPILER, *_OPTIONS, headers, "-o", library, *sources, coverage], check=True)
    return library


def environment(library: Path) -> dict[str, str]:
    """For a Python that calls it."""
    runtime = subprocess.run([COMPILER, "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    return {
        **os.environ,
        LIBRARY: str(library),
        "LD_PRELOAD": runtime.stdout.strip(),
        "PYTHONMALLOC": "malloc",
        "ASAN_OPTIONS": "detect_leaks=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }


def use_library() -> None:
    """In such a Python: use it for both ends."""
    if LIBRARY in os.environ:
        from skinware_drivers import native

        native._FILE = Path(os.environ[LIBRARY])
