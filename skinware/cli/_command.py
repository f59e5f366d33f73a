"""Run commands: exit statuses, one clear line for each error, and the options that several commands have.

A command is a module with a click command and ``main = partial(cli.run, command)``.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click
from click.core import ParameterSource

from skinware.cli._terminal import Formatter, echo, patient_output
from skinware.errors import BadRecording, ConfigurationError, SkinwareError

if TYPE_CHECKING:
    from skinware.tactile.regions import Regions

EXIT_DONE, EXIT_FAILED, EXIT_USAGE = 0, 1, 2

CONTEXT_SETTINGS: dict[str, Any] = {"help_option_names": ["-h", "--help"], "show_default": True}
"""For ``click.group(context_settings=...)``: ``-h`` helps everywhere, and shows every default."""

DEFAULT_REGIONS = "regions.toml"
"""File of regions where none is named, in the current folder."""

_Decorated = TypeVar("_Decorated", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)
"""For ``click.option(type=...)``: the path of a file or folder, which need not exist."""


def seconds(text: str) -> float:
    """Return a time in seconds, from 0 to 1e9 (30 years); for ``click.option(type=...)``."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number <= 1e9:
        raise click.BadParameter(f"{text!r} is not a number of seconds from 0 to 1e9.")
    return number


def examples(*lines: str) -> str:
    """Return examples for ``click.command(epilog=...)``, with their line breaks."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])


def command(
    name: str,
    *lines: str,
    cls: type[click.Command] = click.Command,
    context_settings: Mapping[str, Any] | None = None,
    **more: Any,
) -> Callable[[Callable[..., Any]], click.Command]:
    """Make a command of a function, with ``-h``, ``--version``, these examples in its help, and arguments of click."""
    settings = {**CONTEXT_SETTINGS, **(context_settings or {})}
    made = click.command(name, cls, context_settings=settings, epilog=examples(*lines), **more)
    return lambda function: version_option(made(function))


def group(name: str) -> Callable[[Callable[..., Any]], click.Group]:
    made = click.group(name, context_settings=CONTEXT_SETTINGS)
    return lambda function: version_option(made(function))


def options(*given: Callable[[_Decorated], _Decorated]) -> Callable[[_Decorated], _Decorated]:
    """Return several options as one decorator, in this order in the help."""

    def decorate(command: _Decorated) -> _Decorated:
        for option in reversed(given):
            command = option(command)
        return command

    return decorate


def version_option(command: _Decorated) -> _Decorated:
    # one for each command: it keeps the name of the first program that asks
    return click.version_option(package_name="skinware", message="%(prog)s %(version)s")(command)


namespace_option = click.option(
    "--namespace",
    metavar="NAME",
    help="Namespace of drivers and readers.  [default: $SKINWARE_NAMESPACE, else 'default']",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")
group_option = click.option("--group", metavar="GROUP", help="Group whose members may read the namespace.")
driver_argument = click.argument("driver", metavar="[DRIVER]", required=False)
verbose_option = click.option("-v", "--verbose", is_flag=True, help="Log more to stderr.")
names_argument = click.argument("names", metavar="[NAME]...", nargs=-1)
caller_option = click.option(
    "--caller",
    "callers",
    multiple=True,
    metavar="NAME",
    help="Only certificates of this name may call operations (tare ...); may be repeated.",
)
insecure_option = click.option("--insecure", is_flag=True, help="Listen beyond this machine without --tls.")


def tls_option(what: str = "Encrypt; DIR has ca.pem, cert.pem and key.pem.") -> Callable[[_Decorated], _Decorated]:
    folder = click.Path(path_type=Path, file_okay=False)
    return click.option("--tls", metavar="DIR", type=folder, help=what)


def links_option(what: str) -> Callable[[_Decorated], _Decorated]:
    return click.option("--links", metavar="FILE", type=FILE, help=what)


def regions_option(
    what: str = f"File with regions; may be repeated.  [default with --region: {DEFAULT_REGIONS}]",
) -> Callable[[_Decorated], _Decorated]:
    return click.option("--regions", "region_files", metavar="FILE", multiple=True, type=FILE, help=what)


parts_options = options(
    click.option("--patch", "patches", metavar="PATCH", multiple=True, help="Only sensors of PATCH; may be repeated."),
    click.option(
        "--region", "in_regions", metavar="REGION", multiple=True, help="Only sensors in REGION; may be repeated."
    ),
    regions_option(),
)


def type_option(what: str) -> Callable[[_Decorated], _Decorated]:
    return click.option("--type", "type_name", metavar="TYPE", help=what)


def duration_option(what: str = "End after SECONDS.", default: str | None = None) -> Callable[[_Decorated], _Decorated]:
    """``-T SECONDS``: the command ends by itself after this time."""
    return click.option("-T", "duration_s", metavar="SECONDS", type=seconds, default=default, help=what)


def output_option(
    what: str, *, name: str = "output", metavar: str = "FILE", required: bool = False, default: str | None = None
) -> Callable[[_Decorated], _Decorated]:
    """``-o FILE``: where the command writes."""
    return click.option(
        "-o", "--output", name, metavar=metavar, type=FILE, required=required, default=default, help=what
    )


def regions_of(files: Sequence[Path], names: Collection[str] = ()) -> Regions:
    """Return the regions of files, or of the default file; refuse names of others."""
    from skinware.tactile.regions import read_regions, unknown

    regions = read_regions(*(files or (DEFAULT_REGIONS,)))
    for why in unknown("region", names, [region.name for region in regions]):
        raise ConfigurationError(why)
    return regions


def regions_asked_for(names: Collection[str], files: Sequence[Path]) -> Regions:
    """Return the regions of files if some are named, otherwise none; refuse files without names."""
    from skinware.tactile.regions import Regions

    if files and not names:
        raise click.UsageError("--regions names files of regions: choose regions with --region")
    return regions_of(files, names) if names else Regions(())


def pairs(texts: Iterable[str], form: str, *, with_empty: bool = False) -> dict[str, str]:
    """Return texts of the form ``KEY=VALUE`` by key; refuse others, and empty values."""
    found = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key and equals and (value or with_empty)):
            raise ConfigurationError(f"{text!r}: write {form}")
        found[key] = value
    return found


def refuse_others(option: str, allowed: Collection[str]) -> None:
    """Refuse what is given on the command line and is not among the parameters that go with an option."""
    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        is_given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE and context.params[name]
        if is_given and name not in {option.strip("-"), *allowed}:
            shown = parameter.opts[0] if isinstance(parameter, click.Option) else parameter.human_readable_name
            raise click.UsageError(f"{option} goes without {shown}")


def warn(text: str) -> None:
    """Print one line on stderr under the running command's name: a note that is no error."""
    context = click.get_current_context(silent=True)  # of the main thread alone
    echo(f"{context.info_name if context else os.path.basename(sys.argv[0])}: {text}", err=True)


def echo_changes(shown: dict[str, str], states: Mapping[str, str]) -> None:
    """Print each state by name that is another than ``shown``, and note it there."""
    for name, state in states.items():
        if shown.get(name) != state:
            echo(f"{name}: {state}")
        shown[name] = state


def log_to_stderr(verbose: bool) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Formatter(f"{click.get_current_context().info_name}: %(message)s"))
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[handler])


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a command in good order: SIGHUP (its terminal is closed) unless nohup ignores it."""
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hangup]


@contextlib.contextmanager
def signals_end(
    stop: Callable[[], object], others: Mapping[signal.Signals, Callable[[], object]] | None = None
) -> Iterator[None]:
    """Let the ending signals call ``stop``, which ends the block; and other signals other things.

    They are called one after the other in a thread. A handler of signals runs between any two steps of the main thread,
    so it must not take a lock that this thread may hold, and :meth:`threading.Event.set` takes one.
    """
    calls = {**dict.fromkeys(ending_signals(), stop), **(others or {})}
    due: SimpleQueue[Callable[[], object] | None] = SimpleQueue()  # its put may interrupt its put

    def call_all() -> None:
        for call in iter(due.get, None):
            call()

    caller = threading.Thread(target=call_all, daemon=True)
    caller.start()
    with signals_call({number: partial(due.put, call) for number, call in calls.items()}):
        try:
            yield
        finally:
            due.put(None)
            caller.join()


@contextlib.contextmanager
def signals_call(calls: Mapping[signal.Signals, Callable[[], object]]) -> Iterator[None]:
    """Call functions in the main thread, where they may raise, when signals come while the block runs."""
    before = {number: signal.signal(number, lambda *_, call=call: call()) for number, call in calls.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(command: click.Command, *, goes_on: bool = False) -> NoReturn:
    """Run a command with the arguments of this process, and exit with the status of :func:`exit_status`.

    SIGTERM and a closed terminal end a command as Ctrl-C does.

    Args:
        goes_on: its work goes on while its output is not read; by default it waits for the reader, as ``| less`` needs.
    """
    if f"_{command.name}_COMPLETE".upper().replace("-", "_") in os.environ:
        command.main(prog_name=command.name)  # the shell asks for completions
    for number in ending_signals()[1:]:
        signal.signal(number, signal.default_int_handler)
    sys.unraisablehook = _interrupt_again
    with patient_output() if goes_on else contextlib.nullcontext():
        status = exit_status(command, sys.argv[1:])
    for number in ending_signals():
        signal.signal(number, signal.SIG_DFL)  # no traceback of the interpreter's own end
    sys.exit(status)


def _interrupt_again(dropped: sys.UnraisableHookArgs) -> None:
    """Repeat an interrupt that came in a destructor or a callback: Python drops the exceptions of these."""
    if not issubclass(dropped.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(dropped)
        return
    again = threading.Timer(0.05, signal.pthread_kill, (threading.main_thread().ident, signal.SIGTERM))
    again.daemon = True
    again.start()


def exit_status(command: click.Command, arguments: Sequence[str]) -> int:
    """Run a command and return its exit status.

    It is 0 when the command is done or interrupted, 1 when it failed, and 2 for wrong usage or configuration, including
    the files that it names. Every expected error becomes one line on stderr. A closed output (``| head -1``) ends the
    command in silence. ``NO_COLOR`` in the environment removes the colours.
    """
    name = command.name or os.path.basename(sys.argv[0])
    if logging.lastResort is not None:  # for commands that do not log_to_stderr
        logging.lastResort.setFormatter(Formatter(f"{name}: %(message)s"))
    try:
        # command.main() makes a closed pipe a failure
        color = False if os.environ.get("NO_COLOR") else None  # None: colours on a terminal
        with command.make_context(name, list(arguments), color=color) as context:
            command.invoke(context)
        sys.stdout.flush()
        return EXIT_DONE
    except (KeyboardInterrupt, click.Abort):
        return EXIT_DONE
    except click.exceptions.Exit as done:
        return done.exit_code
    except click.ClickException as error:
        text = io.StringIO()
        error.show(file=text)
        echo(text.getvalue(), nl=False, err=True)
        return error.exit_code
    except BrokenPipeError:
        _discard_output()
        return EXIT_DONE
    except SkinwareError as error:
        echo(f"{name}: {error}", err=True)
        return EXIT_USAGE if isinstance(error, ConfigurationError | BadRecording) else EXIT_FAILED
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        where = f"{error.filename}: " if error.filename else "its output cannot be written: " if is_full else ""
        folder = os.path.dirname(error.filename or "")
        if error.errno == errno.ENOENT and folder and not os.path.exists(folder):
            where, error = "", FileNotFoundError(f"there is no folder {folder}")
        echo(f"{name}: {where}{error.strerror or error}", err=True)
        _discard_output()
        return EXIT_USAGE if isinstance(error, FileNotFoundError | FileExistsError) else EXIT_FAILED


def _discard_output() -> None:
    """Discard buffered output, or Python reports it as an error when it exits."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
