"""``skin-regions``: list named parts of a skin, and paint them by hand."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import enter_pressed, say
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot

_REPORT_EVERY_S = 1.0


@cli.group("skin-regions")
def command() -> None:
    """Name parts of a skin: regions, which programs and skin-top use by name."""


@command.command(
    "list",
    epilog=cli.examples(
        "skin-regions list                     regions of regions.toml, with their sensors of the running skin",
        "skin-regions list a.toml b.toml       several files are one set",
    ),
)
@click.argument("files", nargs=-1, metavar="[FILE...]", type=cli.FILE)
@cli.namespace_option
@cli.json_option
def list_(files: tuple[Path, ...], namespace: str | None, as_json: bool) -> None:
    """List regions, and how many sensors the running drivers have in each."""
    from skinware.skin import Skin
    from skinware.text import plural

    regions = cli.regions_of(files)
    with Skin(namespace) as skin:
        layout = skin.refresh()
    counts: dict[str, dict[str, int]] = {region.name: {} for region in regions}
    for type_name in layout.types:
        n = len(layout.uids(type_name))
        for name, index in regions.of(layout, type_name).items():
            counts[name][type_name] = len(range(n)[index]) if isinstance(index, slice) else len(index)
    for name, of_type in counts.items():
        found = ", ".join(plural(count, f"{type_name} sensor") for type_name, count in of_type.items() if count)
        say(as_json, {"region": name, "sensors": of_type}, f"{name}: {found or 'nothing in the drivers that run'}")


@command.command(
    epilog=cli.examples(
        "skin-regions paint palm               stroke the palm, then press Enter",
        "skin-regions paint palm left_hand --namespace calm",
        "skin-regions paint palm -T 20 --json  for programs: paint for 20 s",
    ),
)
@click.argument("name")
@cli.driver_argument
@cli.type_option("Sensors to paint.  [default: normal force or pressure, else another touch]")
@cli.output_option("Write the region into this file, new or not.", name="file", default=cli.DEFAULT_REGIONS)
@click.option("-f", "--force", is_flag=True, help="Replace a region of this name.")
@cli.duration_option("Paint for SECONDS, not until Enter.")
@cli.namespace_option
@cli.json_option
def paint(
    name: str,
    driver: str | None,
    type_name: str | None,
    file: Path,
    force: bool,
    duration_s: float | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Make region NAME of the sensors of DRIVER, or of the only one that runs, that you stroke.

    Leave the skin alone for the first second. Holes are closed where the driver knows the places of its sensors.
    """
    from skinware.memory.namespace import Namespace
    from skinware.tactile.regions import Region, put_region, read_regions
    from skinware.views.live import reader_of
    from skinware.views.quantities import types_of

    if duration_s is None and not sys.stdin.isatty():
        raise click.UsageError("without a terminal there is no Enter: give -T SECONDS")
    if file.exists() and not force and name in [region.name for region in read_regions(file)]:
        raise ConfigurationError(f"{file}: there is a region {name!r} already; --force replaces it")
    with reader_of(Namespace(namespace), driver, "skin-regions paint NAME DRIVER") as reader:
        type_name = type_name or types_of(reader.structure)[0].name
        stroked, in_region = _paint(reader, type_name, as_json, duration_s)
        uid = reader.structure.sensor_uid[reader.structure.index(type_name)][in_region]
    if not len(uid):
        raise click.ClickException("nothing was touched; nothing is written")
    put_region(file, Region(name, type_name, (reader.name,), tuple(uid.tolist())), replace=force)
    holes = f", {len(uid) - stroked} of them holes that were closed" if len(uid) > stroked else ""
    done = {"event": "done", "region": name, "file": str(file), "touched": stroked, "sensors": len(uid)}
    say(as_json, done, f"{file}: {name}, {len(uid)} {type_name} sensors of {reader.name}{holes}")


def _paint(
    reader: DriverReader, type_name: str, as_json: bool, duration_s: float | None
) -> tuple[int, npt.NDArray[np.bool_]]:
    """Paint until Enter or for this time; return the number of touched sensors, and (n,) bool: the region."""
    import numpy as np

    from skinware.tactile.neighbours import neighbours, without_holes
    from skinware.views.history import SETTLING_S, DriverRest, threshold
    from skinware.views.live import after, frames_until

    structure = reader.structure
    index, rest = structure.index(type_name), DriverRest(structure)

    def touched(frame: DriverSnapshot) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: the sensors of the type that are far from rest."""
        physical, fresh = frame.physical_values(), frame.status == 0
        rest.follow(physical, fresh, frame.published_ns)
        is_far = rest.change(physical)[index] > threshold(rest.noise(type_name))
        is_touched: npt.NDArray[np.bool_] = fresh[index] & is_far
        return is_touched

    for frame in frames_until(reader, after(SETTLING_S)):
        touched(frame)
    stroked = np.zeros(len(structure.module_of(type_name)), bool)
    ready = {"event": "ready", "driver": reader.name, "type": type_name, "touched": 0}
    say(as_json, ready, f"stroke the region{' and press Enter' if duration_s is None else ''}")
    is_due = after(_REPORT_EVERY_S)
    for frame in frames_until(reader, enter_pressed if duration_s is None else after(duration_s)):
        stroked |= touched(frame)
        if is_due():
            is_due, count = after(_REPORT_EVERY_S), int(stroked.sum())
            say(as_json, {"event": "painting", "touched": count}, f"{count} sensors")
    if structure.geometry is None:
        return int(stroked.sum()), stroked
    return int(stroked.sum()), without_holes(stroked, neighbours(structure.geometry[index]))


main = partial(cli.run, command)
