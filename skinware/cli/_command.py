"""What all commands share: exit codes, one clear line per error, JSON lines, the namespace option."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import click

from skinware.errors import BusNotAvailable, ConfigurationError, SkinwareError

EXIT_FAILED, EXIT_USAGE, EXIT_NO_BUS = 1, 2, 3

_Decorated = TypeVar("_Decorated", bound=Callable[..., Any])


def namespace_option(command: _Decorated) -> _Decorated:
    """``--namespace NAME``."""
    text = "Namespace to meet in.  [default: $SKINWARE_NAMESPACE, else 'default']"
    return click.option("--namespace", metavar="NAME", help=text)(command)


def json_option(command: _Decorated) -> _Decorated:
    """``--json``."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")(command)


def print_json(data: object) -> None:
    """One object on one line, at once."""
    sys.stdout.write(json.dumps(data, separators=(",", ":")) + "\n")
    sys.stdout.flush()


def run(command: click.Command) -> NoReturn:
    """Run a command and exit: 0 done or interrupted, 1 failed, 2 wrong usage or configuration, 3 no bus.

    SIGTERM ends a command as Ctrl-C does. A reader of our output that goes away ends it in silence.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    sys.exit(_exit_code(command))


def _exit_code(command: click.Command) -> int:
    try:
        # not command.main(): it has exit codes of its own for a closed pipe
        with command.make_context(command.name, sys.argv[1:]) as context:
            command.invoke(context)
        sys.stdout.flush()
        return 0
    except click.exceptions.Exit as leaving:
        return leaving.exit_code
    except (KeyboardInterrupt, click.Abort):
        return 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it exits
        return 0
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except SkinwareError as error:
        click.echo(f"{command.name}: {error}", err=True)
        if isinstance(error, ConfigurationError):
            return EXIT_USAGE
        return EXIT_NO_BUS if isinstance(error, BusNotAvailable) else EXIT_FAILED


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt
