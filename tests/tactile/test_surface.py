"""What algorithms start from is found in one place, and costs nothing before it is asked for."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import skinware.tactile as tactile


def test_every_name_that_is_listed_is_there_and_type_checkers_are_told_of_it() -> None:
    tree = ast.parse(Path(tactile.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    told = {alias.name: str(node.module) for node in imports for alias in node.names}
    ours = {name: place for name, place in told.items() if place.startswith("skinware.tactile.")}
    assert sorted(ours) == sorted(tactile.__all__)
    for name, place in ours.items():
        assert getattr(tactile, name) is getattr(importlib.import_module(place), name)


def test_what_is_not_there_cannot_be_imported() -> None:
    with pytest.raises(ImportError, match="cannot import name 'Contcats'"):
        exec("from skinware.tactile import Contcats")


@pytest.mark.thorough
def test_nothing_is_imported_before_it_is_asked_for() -> None:
    code = (
        "import sys, skinware; assert not any(name.startswith('skinware.tactile') for name in sys.modules)\n"
        "import skinware.tactile; assert 'skinware.tactile.baseline' not in sys.modules\n"
        "from skinware.tactile import Baseline; assert 'skinware.tactile.contacts_service' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
