"""The computer of somebody who has installed Skinware and knows nothing of this repository."""

from __future__ import annotations

import os
import signal
import site
import subprocess
import sysconfig
import venv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.commands import BIN

PATIENCE_S = 300.0


class Stranger:
    """A Python environment with a built wheel of Skinware, and beside it what this environment has installed.

    No network is used. What this environment has is seen, but not what its ``.pth`` files do: so an editable
    installation of Skinware in it is not.

    Args:
        folder: new, for everything.
        wheel: of Skinware.
        mypy_cache: may be shared with others.

    Attributes:
        home: an empty folder to work in.
    """

    def __init__(self, folder: Path, wheel: Path, mypy_cache: Path) -> None:
        self.home = folder / "home"
        self._bin = folder / "env" / "bin"
        scratch = folder / "tmp"
        for new in (self.home, scratch):
            new.mkdir(parents=True)
        venv.create(folder / "env", with_pip=False, symlinks=True)
        packages = sysconfig.get_path("purelib", vars={"base": str(folder / "env")})
        (Path(packages) / "present.pth").write_text("".join(f"{place}\n" for place in site.getsitepackages()))
        keep = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("PYTHON", "PYTEST", "COV", "VIRTUAL_ENV"))
        }
        self._environ = {
            **keep,
            "PATH": f"{self._bin}:{os.environ['PATH']}",
            "HOME": str(self.home),
            "TMPDIR": str(scratch),
            "PIP_NO_INDEX": "1",
            "PIP_NO_BUILD_ISOLATION": "0",  # means: no isolation
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
            "MYPY_CACHE_DIR": str(mypy_cache),
        }
        self._add_commands()
        self.do("pip", "install", "--quiet", "--no-deps", str(wheel), cwd=folder)

    @property
    def environ(self) -> dict[str, str]:
        """Environment of its processes: they meet in the namespace of the test that runs."""
        return {**self._environ, "SKINWARE_NAMESPACE": os.environ.get("SKINWARE_NAMESPACE", "default")}

    def do(self, *command: str, cwd: Path | None = None) -> str:
        """Run a command to its end; its output. It must succeed."""
        with self._started(command, cwd) as process:
            try:
                told, _ = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()  # nothing happens to one that has ended
        assert process.returncode == 0, f"{' '.join(command)}\n{told}"
        return told

    def _started(self, command: Sequence[str], cwd: Path | None) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [self._bin / command[0], *command[1:]],
            cwd=cwd or self.home,
            env=self.environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def _add_commands(self) -> None:
        """The commands of packages that are installed beside: Python's run with this environment's."""
        (self._bin / "ruff").symlink_to(BIN / "ruff")
        for name in ("pip", "pytest", "mypy"):
            path = self._bin / name
            path.write_text(f'#!/bin/sh\nexec {self._bin / "python"} -m {name} "$@"\n')
            path.chmod(0o755)

    @contextmanager
    def running(self, *command: str, cwd: Path | None = None) -> Iterator[None]:
        """A command that is interrupted at the end; it must then end well."""
        process = self._started(command, cwd)
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, f"{' '.join(command)}\n{output}"
