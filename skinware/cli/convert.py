"""``skin-convert``: write a recording in the formats of other programs, or make one of their data."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware.conversion import Selection
    from skinware.conversion.converting import Converted


def _window(text: str) -> int:
    if text == "all":
        return 0
    if not text.isdecimal() or not int(text):
        raise click.BadParameter(f"{text!r} is not a number of samples, nor all.")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise click.BadParameter(f"{text!r} is not WIDTHxHEIGHT, as in 96x48.")
    return int(height), int(width)


def _range(text: str) -> tuple[float, float]:
    lowest, _, highest = text.partition("..")
    try:
        found = float(lowest), float(highest)
    except ValueError:
        found = 0.0, 0.0
    if not found[0] < found[1]:
        raise click.BadParameter(f"{text!r} is not LOWEST..HIGHEST, as in 0..4095.")
    return found


_learning_options = cli.options(
    click.option(
        "--also",
        metavar="FILE",
        multiple=True,
        type=cli.FILE,
        help="lerobot: a further recording; may be repeated.",
    ),
    click.option("--fps", type=click.IntRange(1), default=30, metavar="N", help="lerobot: rows a second."),
    click.option("--task", metavar="TEXT", help="lerobot: the task that is shown.  [default: FILE's name]"),
    click.option(
        "--episode",
        metavar="START..END",
        multiple=True,
        help="lerobot: an episode, s since the recording began; may be repeated.  [default: all of it is one]",
    ),
    click.option(
        "--episodes",
        metavar="CSV",
        type=cli.FILE,
        help="lerobot: a file of episodes: start_s,end_s,task,file.",
    ),
    click.option(
        "--marks", is_flag=True, help="lerobot: each mark begins an episode, its text is the task; a mark end ends one."
    ),
    click.option(
        "--as",
        "form",
        type=click.Choice(["tactile", "state", "images", "points"]),
        default="tactile",
        help="lerobot: touch as features of its own, or as stock policies read it.",
    ),
    click.option(
        "--numbers",
        type=click.Choice(["module", "taxel", "point"]),
        default="module",
        help="lerobot, as state: sum and largest value of each module; each taxel; or place and force of each.",
    ),
    click.option("--size", type=_size, default="64x64", metavar="WIDTHxHEIGHT", help="lerobot, as images."),
    click.option(
        "--colours",
        type=click.Choice(["grey", "signed", "log"]),
        default="grey",
        help="lerobot, as images.",
    ),
    click.option(
        "--range",
        "value_range",
        type=_range,
        metavar="LOWEST..HIGHEST",
        help="lerobot, as images: darkest and brightest value.  [default: of the sensor type]",
    ),
    click.option("--video", is_flag=True, help="lerobot: images as videos: small, and not exact."),
    click.option(
        "--resample",
        type=click.Choice(["previous", "nearest", "linear"]),
        default="previous",
        help="lerobot: the newest sample at a row, the nearest, or values between the two around it.",
    ),
    click.option(
        "--gap",
        type=cli.seconds,
        metavar="SECONDS",
        help="lerobot: a longer silence of a driver begins the next episode.",
    ),
    click.option(
        "--window",
        type=_window,
        default="1",
        metavar="N",
        help="lerobot: samples of a driver in each row; all: every sample between two rows.",
    ),
    click.option(
        "--join",
        metavar="FEATURE=FILE[:COLUMN,...]",
        multiple=True,
        help="lerobot: columns of a CSV, Parquet or NPZ file with times, as a feature; may be repeated.",
    ),
    click.option(
        "--match",
        type=click.Choice(["previous", "nearest"]),
        default="previous",
        help="lerobot: which of those times belongs to a row.",
    ),
    click.option(
        "--within",
        type=cli.seconds,
        metavar="SECONDS",
        help="lerobot: longest distance of that time from the row.  [default: the time between two rows]",
    ),
    click.option(
        "--at",
        metavar="FEATURE",
        default="",
        show_default=False,
        help="lerobot: rows at the times of a joined feature, such as a camera.",
    ),
)
_PROGRESS_S = 2.0
_FORMATS = ("csv", "npz", "parquet", "hdf5", "mcap", "foxglove", "ros2")
_WIRE_FORMATS = ("candump", "pcapng")
_LEARNING_FORMATS = ("lerobot",)


@cli.command(
    "skin-convert",
    "skin-convert walk.mcap --to npz                        writes walk.npz",
    "skin-convert walk.mcap torso --to csv --type pressure --start 10 --end 12",
    "skin-convert walk.mcap --to parquet --region palm -o palm",
    "skin-convert walk.mcap --to mcap --end 12 -o part.mcap a part, still a recording",
    "skin-convert walk.mcap --to candump                    the frames on CAN buses, for canplayer",
    "skin-convert walk.mcap --to foxglove                   for Foxglove and Lichtblick",
    "skin-convert walk.mcap --to ros2                       a bag of ROS 2",
    "skin-convert pick.mcap --to lerobot --fps 30 --join observation.state=joints.csv    a learning set",
    "skin-convert pick.mcap --to lerobot --as images --size 96x48 --marks",
    "skin-convert data.csv --guess > map.toml               your own data: which columns are taxels?",
    "skin-convert data.csv --map map.toml --to mcap         a recording of them",
)
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@cli.names_argument
@click.option(
    "--to",
    "format_name",
    type=click.Choice(_FORMATS + _WIRE_FORMATS + _LEARNING_FORMATS),
    help="Format to write.",
)
@click.option(
    "--map",
    "map_file",
    metavar="MAP",
    type=cli.FILE,
    help="FILE is of another program (CSV, NPZ, Parquet, LeRobot, a bag of ROS, YARP's data.log); MAP has its columns.",
)
@click.option("--guess", is_flag=True, help="Print a MAP for FILE, with a comment for each guess.")
@cli.output_option("The new file, or folder for csv, parquet, ros2 and lerobot.  [default: beside FILE]", metavar="OUT")
@click.option("--type", "types", metavar="TYPE", multiple=True, help="Only sensors of TYPE; may be repeated.")
@cli.parts_options
@click.option("--start", "start_s", type=cli.seconds, default="0", metavar="SECONDS", help="Begin there.")
@click.option("--end", "end_s", type=cli.seconds, metavar="SECONDS", help="End there.")
@_learning_options
@cli.json_option
def command(
    file: Path,
    names: tuple[str, ...],
    format_name: str | None,
    map_file: Path | None,
    guess: bool,
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

    With --map, FILE is data of another program, of which a recording (--to mcap) or another format is made.

    candump and pcapng contain the frames on the buses, if they were recorded (skin-record --wire). lerobot is a
    learning set (LeRobot's dataset v3.0): rows at a fixed rate, in episodes, with joints and cameras beside the skin.

    FILE does not change; its damaged parts are left out and reported. The new file appears when it is complete.
    """
    from skinware.conversion import Selection, convert
    from skinware.tactile.regions import SensorChoice

    if guess:
        from skinware.conversion.foreign import guess as guess_map
        from skinware.conversion.foreign import open_source

        cli.refuse_others("--guess", ["file"])
        with contextlib.closing(open_source(file)) as source:
            echo(guess_map(source), nl=False)
        return
    if format_name is None:
        raise click.UsageError("Missing option '--to'.")
    if map_file is not None:
        cli.refuse_others("--map", ["file", "map_file", "format_name", "output", "as_json"])
    regions = cli.regions_asked_for(in_regions, region_files)
    selection = Selection(names, SensorChoice(types, patches, regions, in_regions))
    if end_s is not None and end_s <= start_s:
        raise click.UsageError(f"--end {end_s:g} is not after --start {start_s:g}")
    source_of = click.get_current_context().get_parameter_source
    given = [name for name in learning if source_of(name) is not ParameterSource.DEFAULT]
    if given and format_name not in _LEARNING_FORMATS:
        raise click.UsageError(f"--{given[0].replace('_', '-')} is for --to {', '.join(_LEARNING_FORMATS)}")
    stop = Event()
    with cli.signals_end(stop.set):  # not inside a library
        time_and_end: dict[str, Any] = {"start_s": start_s, "end_s": end_s, "is_stopped": stop.is_set}
        if map_file is not None:
            converted = _imported(file, map_file, output, format_name, stop.is_set)
        elif format_name in _LEARNING_FORMATS:
            converted = _learning_set(file, output, selection, learning, time_and_end)
        else:
            converted = convert(file, output, format_name, selection, **time_and_end)
    for note in converted.notes:
        cli.warn(note)
    in_episodes = {"episodes": converted.episodes} if converted.episodes is not None else {}
    if as_json:
        result = {"event": "converted", "file": str(converted.path), "format": format_name}
        print_json({**result, "frames": dict(converted.frames), **in_episodes, "notes": converted.notes})
        return
    unit = "frames" if format_name in _WIRE_FORMATS else "rows" if format_name in _LEARNING_FORMATS else "samples"
    counts = ", ".join(f"{count} {unit} of {name}" for name, count in converted.frames.items())
    echo(f"{converted.path}: {counts}" + (f" in {converted.episodes} episodes" if in_episodes else ""))


def _imported(
    file: Path, map_file: Path, output: Path | None, format_name: str, is_stopped: Callable[[], bool]
) -> Converted:
    from skinware.conversion import FORMATS, convert_foreign

    if format_name not in FORMATS:
        raise click.UsageError(f"--map makes one of {', '.join(FORMATS)}; then convert the recording to {format_name}")
    shown_s = time.monotonic()

    def report(share: float) -> None:
        nonlocal shown_s
        if time.monotonic() - shown_s >= _PROGRESS_S:
            shown_s = time.monotonic()
            cli.warn(f"{file}: {share:.0%}")

    return convert_foreign(file, output, format_name, map_file, report=report, is_stopped=is_stopped)


def _learning_set(
    file: Path, output: Path | None, selection: Selection, options: dict[str, Any], time_and_end: dict[str, Any]
) -> Converted:
    from skinware.conversion.learning import LearningSet, convert_to_learning_set, interval_of, join_of, read_intervals

    intervals = [interval_of(text) for text in options["episode"]]
    if options["episodes"] is not None:
        intervals += read_intervals(options["episodes"])
    wanted = LearningSet(
        fps=options["fps"],
        task=options["task"],
        window=options["window"],
        intervals=intervals,
        gap_s=options["gap"],
        joins=[join_of(text) for text in options["join"]],
        match=options["match"],
        within_s=options["within"],
        at=options["at"],
        by_marks=options["marks"],
        **{name: options[name] for name in ("form", "numbers", "size", "colours", "value_range", "resample", "video")},
    )
    return convert_to_learning_set([file, *options["also"]], output, wanted, selection, **time_and_end)


main = partial(cli.run, command)
