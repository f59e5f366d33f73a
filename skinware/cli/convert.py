"""``skin-convert``: a recording in the formats of other programs, and back."""

from __future__ import annotations

from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    examples,
    json_option,
    run,
    seconds,
    signals_end,
    version_option,
    warn,
)
from skinware.cli._learning import asked_for, learning_options, learning_set
from skinware.cli._regions import regions_asked_for, regions_option
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware.conversion import Selection
    from skinware.conversion.converting import Converted

_FORMATS = ("csv", "npz", "parquet", "hdf5", "mcap", "foxglove", "ros2")
_WIRE_FORMATS = ("candump", "pcapng")
_LEARNING_FORMATS = ("lerobot",)


@click.command(
    "skin-convert",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-convert walk.mcap --to npz                        writes walk.npz",
        "skin-convert walk.mcap torso --to csv --type pressure --start 10 --end 12",
        "skin-convert walk.mcap --to parquet --region palm -o palm",
        "skin-convert walk.npz --to mcap -o again.mcap          and back",
        "skin-convert walk.mcap --to candump                    what went over CAN buses, for canplayer",
        "skin-convert walk.mcap --to foxglove                   for Foxglove and Lichtblick",
        "skin-convert walk.mcap --to ros2                       a bag of ROS 2",
        "skin-convert pick.mcap --to lerobot --fps 30 --join observation.state=joints.csv    a learning set",
    ),
)
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option(
    "--to",
    "format_name",
    type=click.Choice(_FORMATS + _WIRE_FORMATS + _LEARNING_FORMATS),
    required=True,
    help="Format to write.",
)
@click.option(
    "-o",
    "--output",
    metavar="OUT",
    type=click.Path(path_type=Path),
    help="The new file; of csv, parquet, ros2 and lerobot, folder.  [default: beside FILE]",
)
@click.option("--type", "types", metavar="TYPE", multiple=True, help="Only sensors of TYPE; repeat it for several.")
@click.option("--patch", "patches", metavar="PATCH", multiple=True, help="Only sensors of PATCH; likewise.")
@click.option("--region", "in_regions", metavar="REGION", multiple=True, help="Only sensors in REGION; likewise.")
@regions_option
@click.option("--start", "start_s", type=seconds, default="0", metavar="SECONDS", help="Begin there.")
@click.option("--end", "end_s", type=seconds, metavar="SECONDS", help="End there.")
@learning_options
@json_option
@version_option
def command(
    file: Path,
    names: tuple[str, ...],
    format_name: str,
    output: Path | None,
    types: tuple[str, ...],
    patches: tuple[str, ...],
    in_regions: tuple[str, ...],
    region_files: tuple[Path, ...],
    start_s: float,
    end_s: float | None,
    as_json: bool,
    **learning: Any,
) -> None:
    """Write a recording in another format: all drivers and services in it, or only NAME...

    candump and pcapng are of what went over the buses, if that was recorded (skin-record --wire). lerobot is a learning
    set (LeRobot's dataset v3.0): rows at a fixed rate, in episodes, with joints and cameras beside the skin.

    FILE may also be what this command wrote as npz, hdf5 or parquet. It is only read; what is damaged in it is left out
    and told. The new file is there when it is complete, not before.
    """
    selection = _selection(names, types, patches, in_regions, region_files)
    if end_s is not None and end_s <= start_s:
        raise click.UsageError(f"--end {end_s:g} is not after --start {start_s:g}")
    asked = asked_for()
    if asked and format_name not in _LEARNING_FORMATS:
        raise click.UsageError(f"{asked[0]} is for --to {', '.join(_LEARNING_FORMATS)}")
    stop = Event()
    with signals_end(stop.set):  # not in the middle of what libraries do
        converted = _written(
            file, output, format_name, selection, learning, start_s=start_s, end_s=end_s, is_stopped=stop.is_set
        )
    for note in converted.notes:
        warn(note)
    in_episodes = {"episodes": converted.episodes} if converted.episodes is not None else {}
    if as_json:
        told = {"file": str(converted.path), "format": format_name, "frames": dict(converted.frames), **in_episodes}
        print_json({"event": "converted", **told, "notes": converted.notes})
        return
    frames = ", ".join(f"{count} frames of {name}" for name, count in converted.frames.items())
    echo(f"{converted.path}: {frames}" + (f" in {converted.episodes} episodes" if in_episodes else ""))


def _written(
    file: Path,
    output: Path | None,
    format_name: str,
    selection: Selection,
    learning: dict[str, Any],
    **time_and_end: Any,
) -> Converted:
    from skinware.conversion import convert, convert_wires

    if format_name in _LEARNING_FORMATS:
        from skinware.conversion.learning import convert_to_learning_set

        also, wanted = learning_set(learning)
        return convert_to_learning_set([file, *also], output, wanted, selection, **time_and_end)
    write = convert_wires if format_name in _WIRE_FORMATS else convert
    return write(file, output, format_name, selection, **time_and_end)


def _selection(
    names: tuple[str, ...],
    types: tuple[str, ...],
    patches: tuple[str, ...],
    in_regions: tuple[str, ...],
    region_files: tuple[Path, ...],
) -> Selection:
    from skinware.conversion import Selection

    return Selection(names, types, patches, regions_asked_for(in_regions, region_files), in_regions)


def main() -> None:
    run(command)
