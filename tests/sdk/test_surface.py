"""What authors of drivers import comes from four places, and each says what it has."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import skinware_drivers

PLACES = ["skinware_drivers", "skinware_drivers.can", "skinware_drivers.serial", "skinware_drivers.virtual"]


@pytest.mark.parametrize("place", PLACES)
def test_every_name_that_is_listed_is_there(place: str) -> None:
    module = importlib.import_module(place)
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.parametrize("place", [*PLACES, "skinware", "skinware.aio", "skinware.recording", "skinware.tactile"])
def test_completion_offers_every_name_before_it_is_imported(place: str) -> None:
    code = f"import {place} as place; assert set(place.__all__) <= set(dir(place)), dir(place)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_type_checkers_are_told_of_the_names_that_are_there() -> None:
    tree = ast.parse(Path(skinware_drivers.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    told = {alias.name: str(node.module) for node in imports for alias in node.names}
    ours = {name: place for name, place in told.items() if place.startswith("skinware_drivers.")}
    assert ours.keys() | {"get_include"} == set(skinware_drivers.__all__)
    for name, place in ours.items():
        assert getattr(skinware_drivers, name) is getattr(importlib.import_module(place), name)


def test_what_is_not_there_cannot_be_imported() -> None:
    with pytest.raises(ImportError, match="cannot import name 'Frames'"):
        exec("from skinware_drivers import Frames")


def test_nothing_is_imported_before_it_is_asked_for() -> None:
    code = "import sys, skinware_drivers; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
