"""Options of ``skin-convert`` that are for learning sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from skinware.cli._command import seconds

if TYPE_CHECKING:
    from skinware.conversion.learning import LearningSet

_Command = Callable[..., Any]


def _window(text: str) -> int:
    """How many frames; 0: all.

    Raises:
        click.BadParameter: it is no number of frames.
    """
    if text == "all":
        return 0
    if not text.isdecimal() or not int(text):
        raise click.BadParameter(f"{text!r} is not a number of frames, nor all.")
    return int(text)


_OPTIONS = (
    click.option(
        "--also",
        metavar="FILE",
        multiple=True,
        type=click.Path(path_type=Path),
        help="Of lerobot: a further recording; repeat it for several.",
    ),
    click.option(
        "--fps", type=click.IntRange(1), default=30, show_default=True, metavar="N", help="Likewise: rows a second."
    ),
    click.option("--task", metavar="TEXT", help="Likewise: what is done in it.  [default: FILE's name]"),
    click.option(
        "--episode",
        metavar="START..END",
        multiple=True,
        help="Likewise: an episode, s since the recording began; repeat it for several.  [default: all of it is one]",
    ),
    click.option(
        "--episodes",
        metavar="CSV",
        type=click.Path(path_type=Path),
        help="Likewise: a file of episodes: start_s,end_s,task,file.",
    ),
    click.option(
        "--gap",
        type=seconds,
        metavar="SECONDS",
        help="Likewise: where a driver published nothing for longer, the next episode begins.",
    ),
    click.option(
        "--window",
        type=_window,
        default="1",
        show_default=True,
        metavar="N",
        help="Likewise: of how many frames of a driver each row has the values; all: as many as come between two rows.",
    ),
    click.option(
        "--join",
        metavar="FEATURE=FILE[:COLUMN,...]",
        multiple=True,
        help="Likewise: columns of a CSV, Parquet or NPZ file with times, as a feature; repeat it for several.",
    ),
    click.option(
        "--match",
        type=click.Choice(["previous", "nearest"]),
        default="previous",
        show_default=True,
        help="Likewise: which time of those is a row's.",
    ),
    click.option(
        "--within",
        type=seconds,
        metavar="SECONDS",
        help="Likewise: how far from the row that may be.  [default: the time between two rows]",
    ),
    click.option(
        "--at", metavar="FEATURE", default="", help="Likewise: rows at the times of a joined feature: of a camera."
    ),
    click.option(
        "--each-structure", is_flag=True, help="Likewise: a set for each structure of the drivers, in folders 1, 2 ..."
    ),
)
_NAMES = (
    *("also", "fps", "task", "episode", "episodes", "gap"),
    *("window", "join", "match", "within", "at", "each_structure"),
)


def learning_options(command: _Command) -> _Command:
    """Gives them to a command, as further keyword arguments, for :func:`learning_set`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def asked_for() -> list[str]:
    context = click.get_current_context()
    given = [name for name in _NAMES if context.get_parameter_source(name) is not ParameterSource.DEFAULT]
    return ["--" + name.replace("_", "-") for name in given]


def learning_set(options: Mapping[str, Any]) -> tuple[list[Path], LearningSet]:
    """Further recordings, and how a set is made of all of them.

    Raises:
        ConfigurationError: an option is wrong.
        OSError: the file of episodes cannot be read.
    """
    from skinware.conversion.learning import LearningSet, interval_of, join_of, read_intervals

    intervals = [interval_of(text) for text in options["episode"]]
    if options["episodes"] is not None:
        intervals += read_intervals(options["episodes"])
    return list(options["also"]), LearningSet(
        fps=options["fps"],
        task=options["task"],
        window=options["window"],
        intervals=intervals,
        gap_s=options["gap"],
        joins=[join_of(text) for text in options["join"]],
        match=options["match"],
        within_s=options["within"],
        at=options["at"],
        each_structure=options["each_structure"],
    )
