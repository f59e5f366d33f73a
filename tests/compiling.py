"""Compiles the C and C++ programs of the tests, once each in a run."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

import skinware
from tests.sharing import made_once

_WARNINGS = ("-Wall", "-Wextra", "-Werror")
_SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
LANGUAGES: dict[str, tuple[str, ...]] = {
    "c99": ("gcc", "-std=c99", "-pedantic", "-O2"),
    "c++11": ("g++", "-x", "c++", "-std=c++11", "-O2"),
    "c11": ("gcc", "-std=c11", "-pedantic", "-O2", "-pthread"),
    "c11 sanitized": ("gcc", "-std=c11", "-pedantic", "-pthread", *_SANITIZERS),
    "c11 races": ("gcc", "-std=c11", "-pedantic", "-pthread", "-g", "-O1", "-fsanitize=thread", "-Wno-tsan"),
    "sanitized": ("gcc", "-std=c99", "-pedantic", *_SANITIZERS),
    "sanitized copies": ("gcc", "-std=c99", "-pedantic", "-DCOPY_MAPS", *_SANITIZERS),
}
"""Compiler and options, by what a test calls them."""


def need_compiler(compiler: str) -> None:
    """Skips the test where a compiler is not there, fails it in CI."""
    if shutil.which(compiler) is None:
        message = f"no {compiler} here (Debian and Ubuntu: apt install g++)"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)


def compiled(source: Path, language: str, folder: pytest.TempPathFactory, options: Sequence[str] = ()) -> Path:
    """The program that a source file makes; needs its compiler.

    Args:
        source: one source file.
        language: one of ``LANGUAGES``.
        folder: of the test.
        options: more of them.
    """
    compiler, *language_options = LANGUAGES[language]
    need_compiler(compiler)
    command = [compiler, *language_options, *_WARNINGS, *options, f"-I{skinware.get_include()}", str(source)]
    digest = hashlib.sha256("\0".join((*command, source.read_text())).encode()).hexdigest()

    def compile_into(there: Path) -> None:
        result = subprocess.run([*command, "-o", str(there / source.stem)], capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        assert not result.stderr

    return made_once(folder, f"{source.stem}-{digest[:16]}", compile_into) / source.stem
