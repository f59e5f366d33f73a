"""Commands that take the options of the hardware they are asked for beside their own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import msgspec

    from skinware_drivers.options import Option

_HARDWARE_OPTIONS = "skinware.hardware_options"
_PREFIX = "hardware_"
"""Prefix of the parameters of hardware, so that they never clash with the command's own."""
_LONGEST_KIND = 24
"""Longer kinds are written in the help text, where they can be wrapped."""


class HardwareCommand(click.Command):
    """A command of which ``--driver`` says what further options it has; their values are the texts that were given.

    Args:
        options_of: returns the driver that a command line names, and the options it adds, from the command's own ones.
    """

    def __init__(
        self, *arguments: Any, options_of: Callable[[Mapping[str, Any]], tuple[str, type[msgspec.Struct]]], **more: Any
    ) -> None:
        super().__init__(*arguments, **more)
        self._options_of = options_of

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        from skinware_drivers.options import check_names, describe_options

        driver, options_class = self._options_of(own_values(self, args))
        check_names(options_class, reserved_names(self), str(ctx.info_name), f"driver {driver}")
        ctx.meta[_HARDWARE_OPTIONS] = driver, [_click_option(option) for option in describe_options(options_class)]
        ctx.allow_extra_args = True
        left = super().parse_args(ctx, args)
        if left:
            raise click.UsageError(f"{left[0]!r} is not an option; name a driver with --driver, a bus with --bus", ctx)
        return left

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        _, theirs = ctx.meta.get(_HARDWARE_OPTIONS, ("", []))
        return [*super().get_params(ctx), *theirs]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        driver, theirs = ctx.meta.get(_HARDWARE_OPTIONS, ("", []))
        for title, options in (("Options", super().get_params(ctx)), (f"Options of {driver}", theirs)):
            records = [record for option in options if (record := option.get_help_record(ctx)) is not None]
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def reserved_names(command: click.Command) -> frozenset[str]:
    """Names that no option of hardware can have, because the command's own flags have them."""
    flags = [flag for option in command.params for flag in option.opts] + cli.CONTEXT_SETTINGS["help_option_names"]
    return frozenset(flag[2:].replace("-", "_") for flag in flags if flag.startswith("--"))


def hardware_values(parameters: dict[str, str | None]) -> dict[str, str]:
    """The options of the hardware that were given, by name, of the parameters that a command has beside its own."""
    return {name.removeprefix(_PREFIX): text for name, text in parameters.items() if text is not None}


def own_values(command: click.Command, args: Sequence[str]) -> dict[str, Any]:
    """Return the values of a command's own flags, as texts; the other flags of the command line are ignored."""
    context = click.Context(command, info_name=command.name, ignore_unknown_options=True)
    values, _, _ = command.make_parser(context).parse_args(list(args))
    return values


def _click_option(option: Option) -> click.Option:
    kind, text = option.kind, f"{option.description[:1].upper()}{option.description[1:]}."
    if len(kind) > _LONGEST_KIND:
        words, comma, _ = kind.partition(",")
        kind, text = f"NAME{comma and ',...'}", f"{text[:-1]} ({words.replace('|', ', ')})."
    elif "|" in kind:
        kind = f"[{kind}]"
    if option.required:
        text += "  [required]"
    elif option.default:
        text += f"  [default: {option.default}]"
    flag, name = f"--{option.name.replace('_', '-')}", f"{_PREFIX}{option.name}"
    if option.kind == "yes/no":  # alone, it means yes
        return click.Option([flag, name], metavar="[yes|no]", is_flag=False, flag_value="yes", help=text)
    return click.Option([flag, name], metavar=kind, help=text)
