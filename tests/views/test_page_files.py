"""The files of the page: all of them are used, nothing in them leads to another host."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import skinware

PAGE = Path(skinware.__file__).parent / "views" / "page"
MODULES = sorted(PAGE.glob("*.js"))
VENDORED = PAGE / "vendor" / "three.min.js"
HOST = re.compile(r"https?://[^\s\"'`)]+")
ALLOWED = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml"}
"""Names of formats, which nothing fetches."""
EXPORT = re.compile(r"^export (?:async )?(?:const|class|function) \[?([\w, ]+)", re.MULTILINE)
IMPORT = re.compile(r"^import (?:\{([^}]*)\}|\* as \w+) from \"\./([\w./]+)\";", re.MULTILINE)


def imported(module: Path) -> set[str]:
    """Files that a module imports, from the page's folder."""
    return {file for _, file in IMPORT.findall(module.read_text())}


def test_every_module_is_part_of_the_page() -> None:
    found, waiting = set(), {"main.js"}
    while waiting:
        found |= waiting
        waiting = {file for name in waiting if "/" not in name for file in imported(PAGE / name)} - found
    assert found == {module.name for module in MODULES} | {"vendor/three.min.js"}
    named = re.findall(r'(?:src|href)="([^"]+)"', (PAGE / "index.html").read_text())
    assert set(named) == {"main.js", "style.css", "icon.svg"}


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.name)
def test_what_a_module_exports_is_there_and_used(module: Path) -> None:
    others = "".join(other.read_text() for other in MODULES if other != module)
    tests = "".join(test.read_text() for test in (Path(__file__).parents[1] / "browser").glob("test_page*.py"))
    for names in EXPORT.findall(module.read_text()):
        for name in names.replace(" ", "").split(","):
            assert re.search(rf"\b{name}\b", others) or re.search(rf"\bm\.{name}\b", tests), name
    for names, file in IMPORT.findall(module.read_text()):
        exported = (PAGE / file).read_text()
        for name in names.replace(" ", "").replace("\n", "").strip(",").split(",") if names else ():
            assert re.search(rf"\b{name}\b", exported), f"{name} of {file}"
            assert len(re.findall(rf"\b{name}\b", module.read_text())) > 1, f"{name} is imported, but not used"


@pytest.mark.parametrize("file", [*MODULES, *PAGE.glob("*.html"), *PAGE.glob("*.css"), *PAGE.glob("*.svg"), VENDORED])
def test_nothing_leads_to_another_host(file: Path) -> None:
    assert set(HOST.findall(file.read_text())) <= ALLOWED


def test_the_vendored_file_has_its_licence() -> None:
    assert "MIT License" in (PAGE / "vendor" / "three.LICENSE").read_text()
    assert "MIT licence: see three.LICENSE" in VENDORED.read_text()[:200]


def test_keys_that_do_something_are_those_that_the_page_tells() -> None:
    main, keys = ((PAGE / name).read_text() for name in ("main.js", "keys.js"))
    told = {key for group in re.findall(r'^  \["([^"]+)", "', keys, re.MULTILINE) for key in group.split(" ")}
    listened = main[main.index("onKeys({") : main.index("window.skin")]
    does = set(re.findall(r'^  (?:"([^"]+)"|(\w+)):', listened, re.MULTILINE))
    names = {quoted or plain for quoted, plain in does}
    renamed = {" ": "space", "Escape": "esc"}
    shown = {renamed.get(name, "arrows" if name.startswith("Arrow") else name) for name in names}
    assert shown | {"1", "2", "3", "4"} == told
