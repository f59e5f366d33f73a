"""``skin-recover``: repair a recording that was cut off or damaged."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json


@cli.command(
    "skin-recover",
    "skin-recover walk.mcap                      writes walk.recovered.mcap",
    "skin-recover walk.mcap -o /mnt/walk.mcap    where there is room",
)
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@cli.output_option("The new file.  [default: FILE.recovered.mcap]")
@cli.json_option
def command(file: Path, output: Path | None, as_json: bool) -> None:
    """Repair a recording whose recorder was killed, whose disk was full, or that was damaged.

    Everything undamaged is written into a new file, which other tools can read too. FILE does not change. Skinware
    itself reads such files as they are.
    """
    from skinware.recording.files import recover
    from skinware.text import plural

    target = output or file.with_name(f"{file.stem}.recovered.mcap")
    recovered = recover(file, target)
    if as_json:
        print_json({"event": "recovered", "file": str(target), **asdict(recovered)})
        return
    for channel, count in recovered.messages.items():
        echo(f"{channel}: {plural(count, 'message')}")
    damage = f"{plural(recovered.damaged, 'damaged chunk')} left out" if recovered.damaged else f"{file} was cut off"
    what = f"{file} was whole" if recovered.was_whole else damage
    echo(f"{target}: written; {what}")


main = partial(cli.run, command)
