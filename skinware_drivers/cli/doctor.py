"""``skin-doctor``: why it does not work."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    EXIT_FAILED,
    examples,
    json_option,
    namespace_option,
    run,
    seconds,
    version_option,
)
from skinware.cli._terminal import echo, overwrite, print_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinware_drivers.doctor.evidence import Evidence
    from skinware_drivers.doctor.examining import Examination


@click.command(
    "skin-doctor",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-doctor                       this machine and what runs on it",
        "skin-doctor walk.mcap             a recording",
        "skin-doctor --report report.md    a text to attach to an issue",
        "skin-doctor --json | jq '.findings[] | {severity, what, where}'",
    ),
)
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--seconds", "watch_s", type=seconds, default="3", show_default=True, help="Look for so long.")
@click.option(
    "--report",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write all of it to FILE (Markdown), without names of people, machines and folders.",
)
@namespace_option
@json_option
@version_option
def command(file: Path | None, watch_s: float, report: Path | None, namespace: str | None, as_json: bool) -> None:
    """Look at everything that may be wrong: interfaces, permissions, buses, patches, times, taxels, files, machine.

    With FILE: at a recording. Nothing is sent on any bus, and nothing is changed.

    Exit status: 0 nothing found, 1 something found, 2 wrong usage or not a recording.
    """
    from skinware_drivers.doctor.examining import examine

    progress = _progress()
    evidence = _live(namespace, watch_s, progress) if file is None else _recorded(file, progress)
    progress(-1.0)
    found = examine(evidence)
    if report is not None:
        _write(report, evidence, found)
    if as_json:
        print_json(as_data(evidence, found))
    else:
        from skinware_drivers.cli.doctor_text import as_text

        echo("\n".join(as_text(evidence, found, None if report is None else str(report))))
    if found.findings:
        click.get_current_context().exit(EXIT_FAILED)


def as_data(evidence: Evidence, found: Examination) -> dict[str, Any]:
    import msgspec

    findings = [
        {**msgspec.to_builtins(one), "severity": one.severity.name.lower(), "see": f"docs/{one.see}"}
        for one in found.findings
    ]
    return {
        "file": None if evidence.recording is None else evidence.recording.name,
        "namespace": evidence.namespace,
        "seconds": evidence.seconds,
        "drivers": [driver.name for driver in evidence.drivers],
        "findings": findings,
        "looked": msgspec.to_builtins(found.looked),
        "not_looked": msgspec.to_builtins(found.not_looked),
        "versions": dict(evidence.machine.versions),
    }


def _write(report: Path, evidence: Evidence, found: Examination) -> None:
    """The report, as a file.

    Raises:
        ConfigurationError: it cannot be written.
    """
    from skinware.errors import ConfigurationError
    from skinware_drivers.doctor.report import as_markdown

    try:
        report.write_text(as_markdown(evidence, found), encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{report}: {error.strerror or error}") from None


def _live(namespace: str | None, watch_s: float, tell: Callable[[float], None]) -> Evidence:
    from skinware.memory.namespace import Namespace
    from skinware_drivers.doctor.looking import look

    return look(Namespace(namespace), watch_s, tell)


def _recorded(file: Path, tell: Callable[[float], None]) -> Evidence:
    """Evidence of a recording.

    Raises:
        ConfigurationError: it is none, or cannot be read here.
    """
    from skinware.errors import BadRecording, ConfigurationError, MissingExtra

    try:
        from skinware_drivers.doctor.recorded import look_at

        return look_at(file, tell)
    except (BadRecording, MissingExtra) as error:
        raise ConfigurationError(str(error)) from None
    except OSError as error:
        raise ConfigurationError(f"{file}: {error.strerror or error}") from None


def _progress() -> Callable[[float], None]:
    """Tells how far it is, on a terminal; below 0: it is over."""
    is_terminal = sys.stderr is not None and sys.stderr.isatty()

    def tell(passed_s: float) -> None:
        if is_terminal and passed_s < 0:
            overwrite("", err=True)
        elif is_terminal:
            overwrite(f"looking ... {passed_s:.1f} s", err=True)

    return tell


def main() -> None:
    run(command)
