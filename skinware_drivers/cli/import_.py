"""``skin-import``: translate files of other systems."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skinware_drivers.icub.importer import Import, ImportedPart
    from skinware_drivers.icub.xml_tree import Note

_HEADINGS = {
    "todo": "To fill in or decide",
    "odd": "Worth checking",
    "unknown": "Not understood and left out",
    "missing": "Missing",
    "info": "Nothing to do",
}


@cli.group("skin-import")
def command() -> None:
    """Create configurations for skin-driver from the files of other systems."""


@command.command(
    "icub",
    epilog=cli.examples(
        "skin-import icub iCubGenova02 -o skin             a whole robot",
        "skin-import icub iCubGenova02 positions -o skin   with skinGui's positions",
        "skin-import icub torso.xml --bus 1=can0           one device, on stdout",
        "skin-import icub iCubGenova02 -o skin --yarp yarp:///icub/skin   to read the ports of the running robot",
    ),
)
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=click.Path(path_type=Path, exists=True))
@click.option("-o", "--output", metavar="DIR", type=cli.FILE, help="Write files here.")
@click.option("-f", "--force", is_flag=True, help="Overwrite existing files.")
@click.option(
    "--part", "only", multiple=True, metavar="NAME", help="Only the skin device with this name; may be repeated."
)
@click.option(
    "--bus", "buses", multiple=True, metavar="PATCH=NAME", help="Bus that a patch is attached to, such as 1=can0."
)
@click.option(
    "--positions", multiple=True, metavar="PART=FILE", help="Position file of a body part, if it is not clear."
)
@click.option(
    "--yarp",
    "root",
    metavar="BUS",
    help="Read YARP ports instead of CAN: their common beginning, as yarp://HOST:PORT/icub/skin.",
)
@cli.json_option
@click.option("-v", "--verbose", is_flag=True, help="Also list remarks that need no action.")
def icub(
    paths: tuple[Path, ...],
    output: Path | None,
    force: bool,
    only: tuple[str, ...],
    buses: tuple[str, ...],
    positions: tuple[str, ...],
    root: str | None,
    as_json: bool,
    verbose: bool,
) -> None:
    """Read the skin of an iCub: XML of robots-configuration, positions and drawings of skinGui, or folders of them.

    Configurations go to stdout, or to DIR with a geometry file and a file of regions each. Anything not understood is
    reported on stderr.
    """
    from skinware_drivers.icub.importer import import_files
    from skinware_drivers.icub.xml_tree import Notes

    root = _root(root)
    notes = Notes()
    try:
        done = import_files(
            paths,
            notes,
            only=only,
            positions={name: Path(file) for name, file in cli.pairs(positions, "--positions PART=FILE").items()},
            bus_names={_patch(patch): name for patch, name in cli.pairs(buses, "--bus PATCH=NAME").items()},
            wants_buses=not root,
        )
        if root:
            done.parts = [part for part in done.parts if part.yarp]
        if not done.parts:
            raise ConfigurationError(f"no part could be translated{' that has ports' if root else ''}")
    except ConfigurationError:
        _report(notes.all(), verbose)
        raise
    if output is None and len(done.parts) > 1 and not as_json:
        names = ", ".join(part.part.name for part in done.parts)
        raise ConfigurationError(f"{len(done.parts)} parts ({names}): choose one with --part, or give -o DIR")
    written = [] if output is None else _write(done.parts, output, force, root)
    if as_json:
        print_json(_as_data(done, notes.all(), written, root))
        return
    _report(notes.all(), verbose)
    if output is None:
        echo(done.parts[0].configuration(root=root), nl=False)
        if done.parts[0].groups:
            echo("skin-import: -o DIR writes a geometry file too", err=True)
        return
    for part in done.parts:
        figures = part.figures()
        echo(
            f"{output / part.name}.toml: {sum(len(bus.options.boards) for bus in part.buses)} boards,"
            f" {figures['triangles']} triangles, {figures['sensors']} sensors,"
            f" {figures['sensors_with_a_place']} with a place"
        )


def _patch(text: str) -> int:
    if text not in ("1", "2"):
        raise ConfigurationError(f"--bus {text}=...: a patch is 1 or 2; the bus of a canBusSkin is 1")
    return int(text)


def _root(text: str | None) -> str:
    """Return the beginning of the names of ports; empty: no ports are wanted."""
    from skinware_drivers.streams.yarp_bus import split_channel

    if text is None:
        return ""
    scheme, _, rest = text.rstrip("/").partition("://")
    if scheme != "yarp":
        raise ConfigurationError(f"--yarp {text}: write yarp://HOST:PORT/icub/skin, or yarp:///icub/skin")
    split_channel(f"{rest}/port")
    return f"yarp://{rest}"


def _write(parts: Sequence[ImportedPart], folder: Path, force: bool, root: str) -> list[dict[str, str]]:
    texts: dict[Path, str] = {}
    written = []
    for part in parts:
        files = {"config": folder / f"{part.name}.toml"}
        has_places = any(port.groups for port in part.yarp) if root else part.groups
        geometry = part.geometry(by_port=bool(root)) if has_places else ""
        regions = part.regions_text(by_port=bool(root))
        if geometry:
            files["geometry"] = folder / f"{part.name}.geometry.toml"
            texts[files["geometry"]] = geometry
        if regions:
            files["regions"] = folder / f"{part.name}.regions.toml"
            texts[files["regions"]] = regions
        texts[files["config"]] = part.configuration(files["geometry"].name if geometry else "", root)
        written.append({kind: str(path) for kind, path in files.items()})
    in_the_way = [str(path) for path in texts if path.exists()]
    if in_the_way and not force:
        raise ConfigurationError(f"{', '.join(in_the_way)}: exist already; give another folder, or --force")
    folder.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    return written


def _as_data(done: Import, notes: Sequence[Note], written: Sequence[dict[str, str]], root: str) -> dict[str, object]:
    from skinware_drivers.icub.xml_tree import shown

    parts = []
    for number, part in enumerate(done.parts):
        files = written[number] if written else {"configuration_text": part.configuration(root=root)}
        parts.append({**part.figures(), **files})
    return {"parts": parts, "notes": notes, "files": [shown(path) for path in done.files]}


def _report(notes: Sequence[Note], verbose: bool) -> None:
    for level, heading in _HEADINGS.items():
        of_level = [note for note in notes if note.level == level]
        if not of_level:
            continue
        if level == "info" and not verbose:
            echo(f"{heading}: {len(of_level)} (-v names them)", err=True)
            continue
        echo(f"{heading}:", err=True)
        for note in of_level:
            echo(f"  {note}", err=True)


main = partial(cli.run, command)
