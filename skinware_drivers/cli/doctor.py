"""``skin-doctor``: say why a skin does not work."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, overwrite, print_json, style
from skinware.errors import BadRecording, ConfigurationError, MissingExtra
from skinware.text import age_text, plural, wrapped
from skinware_drivers.doctor.rules import Finding, Severity

if TYPE_CHECKING:
    from skinware_drivers.doctor.evidence import Evidence
    from skinware_drivers.doctor.examining import Examination

_WIDTH = 80
_LABEL, _AREA = 10, 14
_SIGNS = {Severity.ERROR: ("✗", "red"), Severity.WARNING: ("!", "yellow"), Severity.NOTE: ("·", "cyan")}


def as_text(evidence: Evidence, found: Examination, width: int | None = _WIDTH) -> list[str]:
    """Return the lines to print, with colours, which ``echo`` takes out without a terminal."""
    lines = [*wrapped(_verdict(evidence, found), width, hang=0), ""]
    for finding in found.findings:
        lines += [*_finding(finding, width), ""]
    lines += [style("looked at", underline=True)]
    for area, looked in groupby(found.looked, key=lambda one: one.area):
        for number, one in enumerate(looked):
            lines += _row("" if number else area, f"{style(one.what, bold=True)}: {one.seen}", width, _AREA)
    if found.not_looked:
        lines += ["", style("not looked at", underline=True)]
        for area, not_looked in groupby(found.not_looked, key=lambda one: one.area):
            for number, missing in enumerate(not_looked):
                lines += _row("" if number else area, f"{style(missing.what, bold=True)}: {missing.why}", width, _AREA)
                lines += [f"{'':{_AREA + 2}}$ {command}" for command in missing.commands]
    return lines


def _verdict(evidence: Evidence, found: Examination) -> str:
    span = age_text(evidence.seconds * 1e9)
    drivers = plural(len(evidence.drivers), "driver")
    if evidence.recording is not None:
        about = f"{evidence.recording.name}, {span} of {drivers}"
    else:
        about = f"namespace {evidence.namespace}, {drivers}, looked at for {span}"
    counts = [
        style(plural(count, severity.name.lower()), fg=_SIGNS[severity][1], bold=True)
        for severity in sorted(Severity, reverse=True)
        if (count := sum(one.severity == severity for one in found.findings))
    ]
    verdict = ", ".join(counts) or style("nothing found", fg="green", bold=True)
    return f"{verdict}  {style(f'({about})', dim=True)}"


def _finding(finding: Finding, width: int | None) -> Iterator[str]:
    sign, colour = _SIGNS[finding.severity]
    head = f"{style(f'{sign} {finding.area}', fg=colour, bold=True)}  {style(finding.what, bold=True)}"
    yield from wrapped(head, width)
    for label, text in (
        ("where", finding.where),
        ("evidence", finding.evidence),
        ("do", finding.action),
    ):
        yield from _row(label, text, width)
    for command in finding.commands:
        yield f"{'':{_LABEL + 2}}{style('$ ' + command, fg='green')}"
    yield from _row("see", style(f"docs/{finding.see}", dim=True), width)


def _row(label: str, text: str, width: int | None, hang: int = _LABEL) -> list[str]:
    head = "  " + style(f"{label:<{hang}}", dim=True)
    return wrapped(head + text, width, hang)


@cli.command(
    "skin-doctor",
    "skin-doctor                       this machine and what runs on it",
    "skin-doctor walk.mcap             a recording",
    "skin-doctor --report report.md    a text to attach to an issue",
    "skin-doctor --json | jq '.findings[] | {severity, what, where}'",
)
@click.argument("file", type=cli.FILE, required=False)
@cli.duration_option("Look for SECONDS.", default="3")
@click.option(
    "--report",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write all of it to FILE (Markdown), without names of people, machines and folders.",
)
@cli.namespace_option
@cli.json_option
def command(file: Path | None, duration_s: float, report: Path | None, namespace: str | None, as_json: bool) -> None:
    """Find out what is wrong: look at interfaces, permissions, buses, patches, times, taxels, files and the machine.

    With FILE: look at a recording. Nothing is sent on any bus, and nothing is changed.

    Exit status: 0 nothing found, 1 something found, 2 wrong usage or not a recording.
    """
    from skinware.memory.namespace import Namespace
    from skinware_drivers.doctor.examining import examine
    from skinware_drivers.doctor.looking import look

    evidence = look(Namespace(namespace), duration_s, _progress) if file is None else _recorded(file)
    _progress(-1.0)
    found = examine(evidence)
    if report is not None:
        from skinware_drivers.doctor.report import as_markdown

        try:
            lines = map(click.unstyle, as_text(evidence, found, width=None))
            report.write_text(as_markdown(lines, evidence.drivers), encoding="utf-8")
        except OSError as error:
            raise ConfigurationError(f"{report}: {error.strerror or error}") from None
    if as_json:
        print_json(as_data(evidence, found))
    else:
        echo("\n".join(as_text(evidence, found)))
        if report is not None:
            echo(f"\nwritten to {report}; read it before you give it to others")
    if found.findings:
        click.get_current_context().exit(cli.EXIT_FAILED)


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


def _recorded(file: Path) -> Evidence:
    try:
        from skinware_drivers.doctor.recorded import look_at

        return look_at(file, _progress)
    except (BadRecording, MissingExtra) as error:
        raise ConfigurationError(str(error)) from None
    except OSError as error:
        raise ConfigurationError(f"{file}: {error.strerror or error}") from None


def _progress(passed_s: float) -> None:
    """Show the passed seconds on a terminal; a negative number ends it."""
    if sys.stderr is not None and sys.stderr.isatty():
        overwrite("" if passed_s < 0 else f"looking ... {passed_s:.1f} s", err=True)


main = partial(cli.run, command)


if __name__ == "__main__":
    main()
