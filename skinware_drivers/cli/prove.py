"""``skin-prove``: walk the owner of a device through a proof of its driver, or compare how it decodes a capture."""

from __future__ import annotations

import contextlib
import platform
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json, style
from skinware.errors import ConfigurationError, DriverError, SkinwareError
from skinware_drivers.cli.hardware_options import hardware_values, own_values

if TYPE_CHECKING:
    from skinware.driver_service import DriverReader
    from skinware.memory.namespace import Namespace
    from skinware_drivers.adapter import AnyAdapter
    from skinware_drivers.proving.proof import Proof, ProofFiles
    from skinware_drivers.proving.updates import Comparison
    from skinware_drivers.proving.walk import Step

_STARTS_WITHIN_S = 30.0
_DRIVER = "from skinware_drivers.cli.driver import main; main()"
_COLOURS = {"passed": "green", "failed": "red", "skipped": "yellow", "not judged": "yellow"}


@cli.command(
    "skin-prove",
    "skin-prove                                    the only driver that runs",
    "skin-prove hand --only index --only palm      only these modules",
    "skin-prove -- --driver xela --bus can0        start it too: the capture then has its first byte",
    "skin-prove --timeout 60 --json                for programs; a line 'skip' leaves a module out",
    "skin-prove --captured hand.mcap               without the device: are the decoded values the same?",
    "skin-prove --captured hand.mcap -- --driver ./my.py",
)
@click.argument("name", required=False)
@click.argument("driver_arguments", metavar="[-- OPTIONS OF SKIN-DRIVER]", nargs=-1, type=click.UNPROCESSED)
@click.option(
    "--type", "type_name", metavar="TYPE", help="Sensors to look at.  [default: pressure, force, or the first]"
)
@click.option("--only", multiple=True, metavar="WORD", help="Modules with WORD in their name; may be repeated.")
@click.option("--timeout", "patience_s", type=cli.seconds, default="30", help="Give up a step after SECONDS.")
@click.option("--rest", "rest_s", type=cli.seconds, default="3", help="Look at the skin at rest for SECONDS.")
@click.option("--tare", "with_tare", is_flag=True, help="At the end, let the driver tare, if it can.")
@click.option(
    "-o",
    "--output",
    "stem",
    metavar="STEM",
    type=cli.FILE,
    help="Write STEM.md, STEM.json and STEM.mcap.  [default: prove-DRIVER-DATE-TIME]",
)
@click.option(
    "--captured",
    metavar="FILE",
    type=cli.FILE,
    help="No device: decode a capture (skin-driver --capture FILE) again, and compare with the recorded values.",
)
@click.option(
    "--save",
    is_flag=True,
    help="With --captured: write the values that are decoded now beside FILE, as the expected ones.",
)
@cli.namespace_option
@cli.json_option
@click.pass_context
def command(
    context: click.Context,
    name: str | None,
    driver_arguments: tuple[str, ...],
    type_name: str | None,
    only: tuple[str, ...],
    patience_s: float,
    rest_s: float,
    with_tare: bool,
    stem: Path | None,
    captured: Path | None,
    save: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Prove the driver of a device: press and stroke where it asks you to, and attach the report to an issue.

    It checks whether the right module answers, sign, saturation, the order of taxels in matrices, dead taxels, rate and
    losses of driver NAME, of the only one that runs, or of one that it starts. Everything is captured. Type "skip" and
    Enter to leave a module out. Only the driver sends to the device.

    With --captured it proves that the driver decodes a capture to the same values as then, and prints the first
    difference. It uses the recorded driver and options; options after the -- replace them.

    Ctrl-C ends the walk; the report holds the checks until then.

    Exit status: 0 proven, 1 something failed, differs, or nothing was pressed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace

    if name is not None and name.startswith("-"):  # nothing stands before the --
        driver_arguments, name = (name, *driver_arguments), None
    if captured is not None:
        cli.refuse_others("--captured", {"save", "driver_arguments", "as_json", *(["name"] if name is None else [])})
        if not _compare(captured, driver_arguments, save=save, as_json=as_json):
            context.exit(cli.EXIT_FAILED)
        return
    if save:
        raise click.UsageError("--save needs --captured")
    from skinware_drivers.proving.proof import Proof, ProofFiles
    from skinware_drivers.proving.walk import Manner, walk

    stem = stem or Path(time.strftime(f"prove-{name or 'driver'}-%Y%m%d-%H%M%S"))
    files = ProofFiles(stem)
    files.refuse_old()
    versions = {"skinware": version("skinware"), "python": platform.python_version(), "linux": platform.release()}
    facts = {
        "date": time.strftime("%Y-%m-%d"),
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
        "verified against": "a device in the hands of its owner, as this table says",
    }
    proof = Proof(name or "driver", "", facts)
    manner = Manner(type_name, only, patience_s, rest_s, with_tare)
    person = _AtTerminal(as_json)
    trouble: Exception | None = None
    with _interrupted_once() as undisturbed:
        try:
            with _captured(name, driver_arguments, Namespace(namespace), files) as reader:
                proof.driver, proof.driver_type = reader.name, reader.driver_type
                walk(reader, person, manner, proof)
                undisturbed()
        except KeyboardInterrupt:
            proof.about["ended early"] = f"interrupted{person.meanwhile}"
        except (SkinwareError, OSError) as error:  # OSError: the terminal is gone
            undisturbed()
            if not proof.checks:
                raise
            trouble = error
            proof.about["ended early"] = f"{error}{person.meanwhile}"
        proof.about["capture"] = files.capture_text(is_whole=bool(driver_arguments))
        trouble = files.write(proof) or trouble
    _print(proof, files, as_json)
    if trouble is not None:
        raise trouble
    if not proof.is_proven:
        context.exit(cli.EXIT_FAILED)


@contextlib.contextmanager
def _captured(
    name: str | None, driver_arguments: Sequence[str], place: Namespace, files: ProofFiles
) -> Iterator[DriverReader]:
    """Capture a running driver, or start one, while the block runs, and yield a reader of it."""
    from skinware.views.live import reader_of
    from skinware_drivers.cli.capturing import captured

    with contextlib.ExitStack() as beside:
        if driver_arguments:
            name = beside.enter_context(_started(driver_arguments, name, place, files))
        reader = beside.enter_context(reader_of(place, name, "skin-prove NAME"))
        if not driver_arguments:
            beside.enter_context(captured(files.capture, reader.name, place.name, files.captured.update))
        yield reader


@contextlib.contextmanager
def _interrupted_once() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C, SIGTERM or a closed terminal interrupt the block once; yield a function that ends that."""
    numbers = cli.ending_signals()

    def undisturbed() -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)

    def interrupt() -> None:
        undisturbed()
        raise KeyboardInterrupt

    with cli.signals_call(dict.fromkeys(numbers, interrupt)):
        yield undisturbed


@contextlib.contextmanager
def _started(arguments: Sequence[str], name: str | None, place: Namespace, files: ProofFiles) -> Iterator[str]:
    """Run a driver that captures while the block runs, and yield its name."""
    from skinware_drivers.cli.capturing import EventProgram

    more = [*(["--name", name] if name else []), "--namespace", place.name, "--capture", str(files.capture), "--json"]
    program = EventProgram(["-c", _DRIVER, *arguments, *more], signal.SIGINT)
    try:
        if not program.is_ready(_STARTS_WITHIN_S):
            attach = f"; {files.capture} holds the frames on its buses: attach it" if files.capture.exists() else ""
            raise DriverError(f"skin-driver publishes nothing{attach}" if attach else "skin-driver did not start")
        yield str(program.events["ready"]["name"])
    finally:
        program.close()
        files.captured.update(program.events.get("captured", {}))


class _AtTerminal:
    """Print the steps for a person or a program, and read ``skip``."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._is_there = sys.stdin is not None and not sys.stdin.closed
        self._asked: Step | None = None

    @property
    def meanwhile(self) -> str:
        return f", while it asked: {self._asked.text}" if self._asked else ""

    def ask(self, step: Step) -> None:
        self._asked = step
        if self._as_json:
            print_json({"event": "step", "wanted": step.wanted, "module": step.module, "text": step.text})
        else:
            echo(f"> {style(step.text, bold=True)}")

    def skips(self) -> bool:
        is_skipped = False
        while self._is_there and select.select([sys.stdin], [], [], 0)[0]:
            line = sys.stdin.readline()
            self._is_there = bool(line)
            is_skipped |= line.strip().lower() == "skip"
        return is_skipped


def _print(proof: Proof, files: ProofFiles, as_json: bool) -> None:
    if as_json:
        print_json({"event": "done", "files": files.written, **proof.as_data()})
        return
    for check in proof.checks:
        verdict = style(f"{check.verdict.value:>10}", fg=_COLOURS[check.verdict.value])
        echo(f"{verdict}  {check.what}{f', {check.where}' if check.where else ''}: {check.seen}")
    if "ended early" in proof.about:
        echo(f"ended early: {proof.about['ended early']}")
    echo(style("proven" if proof.is_proven else "not proven", bold=True))
    if files.captured.get("problem"):
        cli.warn(f"{files.capture} ended early: {files.captured['problem']}")
    if files.written:
        echo(f"written to {', '.join(files.written)}; read them before you give them to others")


def _compare(capture: Path, arguments: Sequence[str], *, save: bool, as_json: bool) -> bool:
    """Compare, print the result, and return whether all values are equal; ``arguments``: of skin-driver."""
    from skinware_drivers.proving import updates
    from skinware_drivers.proving.captures import check_capture, decoded_now, expected_of

    driver, options = _driver_of(capture, arguments)
    try:
        if save:
            now = decoded_now(capture, driver, options)
            if not now:
                raise ConfigurationError(f"{capture}: nothing in it is decoded, so there is nothing to save")
            updates.save(now, expected_of(capture))
        compared, now = check_capture(capture, driver, options)
    except OSError as error:
        raise ConfigurationError(f"{error.filename or capture}: {error.strerror}") from None
    if not compared.then:
        raise ConfigurationError(
            f"{capture}: nothing was decoded then, {compared.now} updates are now; if they are right: --save"
        )
    _print_compared(capture, compared, as_json)
    return compared.difference is None


def _driver_of(capture: Path, arguments: Sequence[str]) -> tuple[type[AnyAdapter] | None, Mapping[str, Any]]:
    """Return the chosen driver and its options; None: the recorded driver."""
    from skinware_drivers.cli.driver import command as driver_command
    from skinware_drivers.options import options_from_strings
    from skinware_drivers.proving.captures import driver_type_of
    from skinware_drivers.registry import load_driver

    if not arguments:
        return None, {}
    name = own_values(driver_command, arguments).get("driver") or driver_type_of(capture)
    context = driver_command.make_context("skin-driver", ["--driver", name, *arguments])
    driver = load_driver(name)
    chosen = {
        key: text
        for key, text in context.params.items()
        if context.get_parameter_source(key) is ParameterSource.COMMANDLINE and key != "driver"
    }
    for option in driver_command.params:
        if option.name in chosen:
            raise click.UsageError(f"--captured: {option.opts[0]} is not about decoding")
    given = hardware_values(chosen)
    options = options_from_strings(driver.Options, given) if given else None
    return driver, {key: getattr(options, key) for key in given}


def _print_compared(capture: Path, compared: Comparison, as_json: bool) -> None:
    difference = compared.difference
    if as_json:
        print_json(
            {
                "event": "compared",
                "file": str(capture),
                "equal": difference is None,
                "compared": compared.compared,
                "then": compared.then,
                "now": compared.now,
                "difference": None if difference is None else asdict(difference),
            }
        )
        return
    counts = f"{compared.then} updates of modules then, {compared.now} now, {compared.compared} compared"
    echo(f"{capture}: {counts}")
    if difference is None:
        echo(style("equal", fg="green"))
    else:
        echo(f"{style('different', fg='red')} {difference}")


main = partial(cli.run, command)
