"""``skin``: list all commands in groups, run any of them, and print completion for shells."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, NamedTuple, NoReturn

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo
from skinware.text import nearest_name


class Tool(NamedTuple):
    module: str
    summary: str


GROUPS: Mapping[str, Mapping[str, Tool]] = {
    "Connect a skin": {
        "find": Tool("skinware_drivers.cli.find", "show which devices are plugged in and which driver knows them"),
        "driver": Tool("skinware_drivers.cli.driver", "run a driver: buses into one stream of snapshots"),
        "doctor": Tool("skinware_drivers.cli.doctor", "find out what is wrong"),
        "config": Tool("skinware_drivers.cli.config", "change settings of boards"),
        "import": Tool("skinware_drivers.cli.import_", "make configurations from files of other systems"),
    },
    "See and feel": {
        "top": Tool("skinware.cli.top", "show all drivers live in the terminal"),
        "view": Tool("skinware.cli.view", "show drivers live in a browser"),
        "info": Tool("skinware.cli.info", "show drivers, buses, patches, services and readers"),
        "dump": Tool("skinware_drivers.cli.dump", "print snapshots of a driver, or frames of a bus"),
        "wipe": Tool("skinware.cli.wipe", "find sensors that never answer"),
        "calm": Tool("skinware.cli.calm", "publish 0 where nothing touches, whatever drifts"),
        "calibrate": Tool("skinware.cli.calibrate", "find where the sensors are by touching them"),
        "regions": Tool("skinware.cli.regions", "name parts of a skin"),
    },
    "Keep and share": {
        "record": Tool("skinware.cli.record", "record drivers and services"),
        "replay": Tool("skinware_drivers.cli.replay", "publish a recording as if it ran now"),
        "convert": Tool("skinware.cli.convert", "write a recording for numpy, pandas, LeRobot, ROS 2, Foxglove"),
        "recover": Tool("skinware.cli.recover", "make a damaged recording whole"),
        "bridge": Tool("skinware.cli.bridge", "share drivers with other machines, ROS 2 or YARP"),
    },
    "Write a driver": {
        "new": Tool("skinware_drivers.cli.new", "create a driver package with emulator and tests"),
        "emulate": Tool("skinware_drivers.cli.emulate", "emulate devices on a bus, with faults on request"),
        "press": Tool("skinware.cli.press", "press an emulated skin"),
        "prove": Tool("skinware_drivers.cli.prove", "prove a driver on its device"),
    },
}
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
_SHELLS = ("bash", "zsh", "fish")


class CommandGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - of click
        return [*COMMANDS, "completion"]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return super().get_command(ctx, cmd_name)
        command: click.Command = import_module(COMMANDS[cmd_name].module).command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in self.list_commands(ctx):
            raise click.UsageError(f"no command {args[0]!r}{nearest_name(args[0], self.list_commands(ctx))}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - of click
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, entry.summary) for name, entry in group.items()])


@click.group(
    "skin",
    cls=CommandGroup,
    context_settings=cli.CONTEXT_SETTINGS,
    invoke_without_command=True,
    epilog="skin NAME --help explains a command; skin-NAME is the same command. Completion: skin completion --help",
)
@cli.version_option
@click.pass_context
def command(context: click.Context) -> None:
    """Read robot skin and tactile hands."""
    if context.invoked_subcommand is None:
        echo(context.get_help())


@command.command(
    "completion",
    epilog=cli.examples(
        "skin completion bash >~/.skin.bash    and in ~/.bashrc: source ~/.skin.bash",
        "skin completion zsh >~/.skin.zsh      and in ~/.zshrc: source ~/.skin.zsh",
        "skin completion fish >~/.config/fish/conf.d/skin.fish",
    ),
)
@click.argument("shell", type=click.Choice(_SHELLS))
def completion(shell: str) -> None:
    """Print completion of all commands for a SHELL."""
    from click.shell_completion import get_completion_class

    make: Callable[..., Any] | None = get_completion_class(shell)
    assert make is not None  # noqa: S101, one of click's own
    for name in ("skin", *(f"skin-{each}" for each in COMMANDS)):
        echo(make(command, {}, name, f"_{name}_COMPLETE".upper().replace("-", "_")).source(), nl=False)


def main() -> NoReturn:
    words = sys.argv[1:]
    if words and words[0] in COMMANDS and "_SKIN_COMPLETE" not in os.environ:
        sys.argv = [f"skin-{words[0]}", *words[1:]]
        import_module(COMMANDS[words[0]].module).main()
    cli.run(command)
