"""What all commands share: how they end, one clear line per error, JSON lines, and the common options.

A command is a module with a click command and::

    def main() -> None:
        run(command)
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import click

from skinware.cli._terminal import Formatter, echo, patient_output
from skinware.errors import BadRecording, ConfigurationError, SkinwareError

EXIT_DONE, EXIT_FAILED, EXIT_USAGE = 0, 1, 2

CONTEXT_SETTINGS = {"help_option_names": ["-h", "--help"]}
"""For ``click.command(context_settings=...)``, so that ``-h`` helps everywhere."""

_Decorated = TypeVar("_Decorated", bound=Callable[..., Any])


def seconds(text: str) -> float:
    """A time in seconds, 0 or more and finite; for ``click.option(type=...)``.

    Raises:
        click.BadParameter: it is not one.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf:
        raise click.BadParameter(f"{text!r} is not a number of seconds.")
    return number


def examples(*lines: str) -> str:
    """Examples for ``click.command(epilog=...)``, which keep their line breaks."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])


def namespace_option(command: _Decorated) -> _Decorated:
    text = "Namespace of drivers and readers.  [default: $SKINWARE_NAMESPACE, else 'default']"
    return click.option("--namespace", metavar="NAME", help=text)(command)


def json_option(command: _Decorated) -> _Decorated:
    return click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")(command)


def group_option(command: _Decorated) -> _Decorated:
    return click.option("--group", metavar="GROUP", help="Group whose members may read the namespace.")(command)


def verbose_option(command: _Decorated) -> _Decorated:
    """``--verbose``, for :func:`log_to_stderr`."""
    return click.option("-v", "--verbose", is_flag=True, help="Log more to stderr.")(command)


def tls_option(command: _Decorated) -> _Decorated:
    return click.option(
        "--tls",
        metavar="DIR",
        type=click.Path(path_type=Path, file_okay=False),
        help="Encrypt; DIR has ca.pem, cert.pem and key.pem.",
    )(command)


def caller_option(command: _Decorated) -> _Decorated:
    return click.option(
        "--caller",
        "callers",
        multiple=True,
        metavar="NAME",
        help="Only certificates of this name may call operations (tare ...); repeatable.",
    )(command)


def insecure_option(command: _Decorated) -> _Decorated:
    return click.option("--insecure", is_flag=True, help="Listen beyond this machine without --tls.")(command)


def version_option(command: _Decorated) -> _Decorated:
    return click.version_option(package_name="skinware", message="%(prog)s %(version)s")(command)


def warn(text: str) -> None:
    """One line on stderr under the running command's name, for what is worth knowing but no error."""
    echo(f"{click.get_current_context().info_name}: {text}", err=True)


def log_to_stderr(verbose: bool) -> None:
    import logging

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Formatter(f"{click.get_current_context().info_name}: %(message)s"))
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[handler])


@contextlib.contextmanager
def signals_end(
    stop: Callable[[], object], others: Mapping[signal.Signals, Callable[[], object]] | None = None
) -> Iterator[None]:
    """SIGINT and SIGTERM end what runs in this block in good order, whatever it is doing.

    Args:
        stop: what they call, in the main thread.
        others: what other signals call.
    """
    calls = {signal.SIGINT: stop, signal.SIGTERM: stop, **(others or {})}
    before = {number: signal.signal(number, lambda *_, call=call: call()) for number, call in calls.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(command: click.Command, *, goes_on: bool = False) -> NoReturn:
    """Run a command with the arguments of this process, and exit as :func:`exit_status` says.

    SIGTERM ends a command as Ctrl-C does.

    Args:
        command: which.
        goes_on: its work goes on while nobody reads its output; by default it waits for who reads, as ``| less`` wants.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    with patient_output() if goes_on else contextlib.nullcontext():
        status = exit_status(command, sys.argv[1:])
    sys.exit(status)


def exit_status(command: click.Command, arguments: Sequence[str]) -> int:
    """Run a command: 0 done or interrupted, 1 failed, 2 wrong usage or configuration, files that it names included.

    Every expected error becomes one line on stderr. Output that nobody reads any more (``| head -1``) ends the command
    in silence. ``NO_COLOR`` in the environment takes the colours away.
    """
    name = command.name or os.path.basename(sys.argv[0])
    if f"_{name}_COMPLETE".upper().replace("-", "_") in os.environ:
        command.main(list(arguments), prog_name=name)  # the shell asks for completions
    try:
        # not command.main(): that one makes a closed pipe a failure
        color = False if os.environ.get("NO_COLOR") else None  # None: where there is a terminal
        with command.make_context(name, list(arguments), color=color) as context:
            command.invoke(context)
        _flush_output()
        return EXIT_DONE
    except (KeyboardInterrupt, click.Abort):
        return EXIT_DONE
    except click.exceptions.Exit as done:
        return done.exit_code
    except click.ClickException as error:
        _show(error)
        return error.exit_code
    except BrokenPipeError:
        _discard_output()
        return EXIT_DONE
    except SkinwareError as error:
        echo(f"{name}: {error}", err=True)
        return EXIT_USAGE if isinstance(error, ConfigurationError | BadRecording) else EXIT_FAILED
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        echo(f"{name}: {where}{error.strerror or error}", err=True)
        _discard_output()
        return EXIT_USAGE if isinstance(error, FileNotFoundError | FileExistsError) else EXIT_FAILED


def _show(error: click.ClickException) -> None:
    text = io.StringIO()
    error.show(file=text)
    echo(text.getvalue(), nl=False, err=True)


def _flush_output() -> None:
    if sys.stdout is not None:  # None: started with stdout closed
        sys.stdout.flush()


def _discard_output() -> None:
    """Send what is still buffered nowhere, or Python complains about it when it exits."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt
