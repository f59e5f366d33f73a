"""Whether wheels have the native data path, and are what their names say: tools/wheelhouse/check.py WHEEL..."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

LIBRARIES = {"skinware/native/libskinware.so", "skinware_drivers/native/libskinware_drivers.so"}
MUSL = {"libc.so"}
"""What zig and musl's loader call musl; auditwheel knows Alpine's name of it only."""


def version(tag: str) -> tuple[str, int, int, str]:
    """``manylinux_2_17_x86_64``: which C library, its oldest version, and the processor."""
    library, major, minor, machine = tag.split("_", 3)
    return library, int(major), int(minor), machine


def trouble(wheel: Path) -> str:
    """What is wrong with a wheel, in one line; empty if nothing is."""
    compiled = {name for name in zipfile.ZipFile(wheel).namelist() if name.endswith(".so")}
    if compiled != LIBRARIES:
        return f"has {sorted(compiled)}, not {sorted(LIBRARIES)}"
    shown = subprocess.run(
        # with libraries of no machine: that of this one is not meant
        [sys.executable, "-m", "auditwheel", "show", "--json", "--ldpaths", "/nonexistent", str(wheel)],
        capture_output=True,
        text=True,
    )
    if shown.returncode:
        return shown.stdout + shown.stderr
    report = json.loads(shown.stdout)
    wanted = version(wheel.stem.split("-")[-1])
    is_musl_alone = wanted[0] == "musllinux" and set(report["external_libs"]) == MUSL
    found = report["sym_tag" if is_musl_alone else "overall_tag"]
    if found.startswith("linux_") or version(found)[::3] != wanted[::3] or version(found) > wanted:
        return f"is {found}: {report['versioned_symbols']}, {report['external_libs']}"
    return ""


def main() -> int:
    troubles = {wheel: trouble(wheel) for wheel in map(Path, sys.argv[1:])}
    for wheel, why in troubles.items():
        print(f"{wheel.name}: {why or 'is what it is called'}")
    return 1 if any(troubles.values()) else 0


sys.exit(main())
