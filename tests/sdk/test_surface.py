"""What authors of drivers import comes from four places, and each says what it has."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from collections.abc import Iterator
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


FACES = [*PLACES, "skinware", "skinware.aio", "skinware.recording", "skinware.tactile"]


def undocumented(place: str) -> Iterator[str]:
    module = importlib.import_module(place)
    for name in module.__all__:
        thing = getattr(module, name)
        if not (inspect.isclass(thing) or inspect.isfunction(thing)) or not thing.__module__.startswith("skinware"):
            continue
        if not inspect.getdoc(thing):
            yield name
        for member, value in vars(thing).items() if inspect.isclass(thing) else ():
            if member.startswith("_") or not (inspect.isroutine(value) or isinstance(value, property | classmethod)):
                continue
            if not inspect.getdoc(getattr(thing, member)):
                yield f"{name}.{member}"


@pytest.mark.parametrize("place", FACES)
def test_every_public_name_has_a_docstring(place: str) -> None:
    assert list(undocumented(place)) == []


@pytest.mark.thorough
@pytest.mark.parametrize("place", FACES)
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
