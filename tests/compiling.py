"""Compiles the C and C++ programs of the tests, once each."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

import skinware

_WARNINGS = ("-Wall", "-Wextra", "-Werror")
_SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
LANGUAGES: dict[str, tuple[str, ...]] = {
    "c99": ("gcc", "-std=c99", "-pedantic", "-O2"),
    "c++11": ("g++", "-x", "c++", "-std=c++11", "-O2"),
    "sanitized": ("gcc", "-std=c99", "-pedantic", *_SANITIZERS),
    "sanitized copies": ("gcc", "-std=c99", "-pedantic", "-DCOPY_MAPS", *_SANITIZERS),
}
"""Compiler and options, by what a test calls them."""

_compiled: dict[tuple[Path, str], Path] = {}


def compiled(source: Path, language: str, folder: pytest.TempPathFactory, options: Sequence[str] = ()) -> Path:
    """The program that a source file makes; skips the test where there is no compiler, fails it in CI.

    Args:
        source: one source file.
        language: one of ``LANGUAGES``.
        folder: where to put it.
        options: more of them.
    """
    compiler, *language_options = LANGUAGES[language]
    if shutil.which(compiler) is None:
        message = f"no {compiler} here (Debian and Ubuntu: apt install g++)"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    if (source, language) not in _compiled:
        program = folder.mktemp("compiled") / source.stem
        command = [compiler, *language_options, *_WARNINGS, *options, f"-I{skinware.get_include()}", str(source)]
        result = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        assert not result.stderr
        _compiled[source, language] = program
    return _compiled[source, language]
