"""Robots' files: real ones, read in place, and small ones made here."""

from __future__ import annotations

from pathlib import Path
from tempfile import NamedTemporaryFile

import pytest

from skinware_drivers.cli.driver_setup import ConfigFile
from skinware_drivers.icub.importer import Import, import_files
from skinware_drivers.icub.xml_tree import Note, Notes

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture
def robots() -> Path:
    """The folder of real configurations."""
    return _real("robots_configuration")


@pytest.fixture
def geometry() -> Path:
    """The folder of real positions."""
    return _real("icub_geometry")


def _real(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the real files are not here: {DATA / name} (from robotology, BSD-3-Clause)")
    return DATA / name


def configuration(text: str) -> ConfigFile:
    """A configuration, as a driver reads it from a file."""
    with NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(text)
        file.flush()
        return ConfigFile(Path(file.name))


DEFAULTS = """
  <group name="defaultCfgBoard">
    <param name="period"> 50 </param> <param name="skinType"> 0 </param>
    <param name="noLoad"> 0xf0 </param> <param name="diagnostic"> false </param>
  </group>
  <group name="defaultCfgTriangle">
    <param name="enabled"> true </param> <param name="shift"> 2 </param> <param name="cdcOffset"> 0x2200 </param>
  </group>
"""

WRAPPER = """<device name="torso_wrapper" type="skinWrapper">
  <paramlist name="ports"><elem name="torso"> 0 383 0 383 </elem></paramlist>
  <action phase="startup" level="5" type="attach">
    <paramlist name="networks"><elem name="FirstSetOfSkins"> torso_skin </elem></paramlist>
  </action>
</device>"""


def device(body: str = DEFAULTS, boards: str = "7 8", kind: str = "canBusSkin") -> str:
    """A skin device with boards on one bus, or (embObjSkin) on what ``boards`` says of patches."""
    if kind == "embObjSkin":
        inner = f'<group name="patches">{boards}</group>'
    else:
        inner = (
            f'<param name="skinCanIds"> {boards} </param> <param name="canDeviceNum"> 0 </param>'
            ' <param name="canbusDevice"> socketcan </param>'
        )
    return f'<device name="torso_skin" type="{kind}">{inner}{body}</device>'


def triangle_sets(*rows: str, count: int | None = None) -> str:
    sets = "".join(f'<param name="triangleSetCfg{n}"> {row} </param>' for n, row in enumerate(rows, 1))
    count = len(rows) if count is None else count
    return f'<group name="specialCfgTriangles"><param name="numOfSets"> {count} </param>{sets}</group>'


def board_sets(*rows: str) -> str:
    sets = "".join(f'<param name="boardSetCfg{n}"> {row} </param>' for n, row in enumerate(rows, 1))
    return f'<group name="specialCfgBoards"><param name="numOfSets"> {len(rows)} </param>{sets}</group>'


class Made:
    """A folder of files, and the result of their import."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notes: list[Note] = []

    def write(self, name: str, text: str | bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def imported(self, **options: object) -> Import:
        notes = Notes()
        try:
            return import_files([self.folder], notes, **options)  # type: ignore[arg-type]
        finally:
            self.notes = notes.all()

    def said(self, level: str) -> str:
        """All remarks of a level, a line each, with the names of files instead of paths."""
        return "\n".join(str(n).replace(f"{self.folder}/", "") for n in self.notes if n.level == level)


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return Made(tmp_path)
