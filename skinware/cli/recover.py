"""``skin-recover``: make a recording whole that was cut off or damaged."""

from __future__ import annotations

from pathlib import Path

import click

from skinware.cli._command import CONTEXT_SETTINGS, examples, json_option, run, version_option
from skinware.cli._terminal import echo, print_json


@click.command(
    "skin-recover",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-recover walk.mcap                      writes walk.recovered.mcap",
        "skin-recover walk.mcap -o /mnt/walk.mcap    where there is room",
    ),
)
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The new file.  [default: FILE.recovered.mcap]",
)
@json_option
@version_option
def command(file: Path, output: Path | None, as_json: bool) -> None:
    """Make a recording whole whose recorder was killed, whose disk was full, or that was damaged.

    All that is undamaged is written into a new file, which other tools then read too; FILE is only read. Skinware's own
    reader reads such files without this.
    """
    from skinware.recording.files import recover

    target = output or file.with_name(f"{file.stem}.recovered.mcap")
    recovered = recover(file, target)
    if as_json:
        damaged = {"damaged": recovered.damaged, "was_whole": recovered.was_whole}
        print_json({"event": "recovered", "file": str(target), "messages": recovered.messages, **damaged})
        return
    for channel, count in recovered.messages.items():
        echo(f"{channel}: {count} messages")
    what = "it was whole" if recovered.was_whole else f"{recovered.damaged} damaged chunks left out"
    echo(f"{target}: written; {what}")


def main() -> None:
    run(command)
