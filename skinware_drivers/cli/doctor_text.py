"""What ``skin-doctor`` found, for people: lines that fit a terminal of 80 columns, but for commands to be copied."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import click

from skinware.cli._format import age_text, plural
from skinware.cli._terminal import style
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import Examination
from skinware_drivers.doctor.finding import Finding, Severity

_WIDTH = 80
_LABEL = 10
_SIGNS = {Severity.ERROR: ("✗", "red"), Severity.WARNING: ("!", "yellow"), Severity.NOTE: ("·", "cyan")}


def as_text(evidence: Evidence, found: Examination, report: str | None = None) -> list[str]:
    """All of it, with colours (which ``echo`` takes out where there is no terminal).

    Args:
        evidence: what was seen.
        found: what came of it.
        report: the file in which it is written too.
    """
    lines = [*_verdict(evidence, found), ""]
    for finding in found.findings:
        lines += [*_finding(finding), ""]
    lines += [style("looked at", underline=True)]
    for area, looked in groupby(found.looked, key=lambda one: one.area):
        for number, one in enumerate(looked):
            lines += _row("" if number else area, f"{style(one.what, bold=True)}: {one.seen}", width=14)
    if found.not_looked:
        lines += ["", style("not looked at", underline=True)]
        for area, not_looked in groupby(found.not_looked, key=lambda one: one.area):
            for number, missing in enumerate(not_looked):
                lines += _row("" if number else area, f"{style(missing.what, bold=True)}: {missing.why}", width=14)
                lines += [f"{'':16}$ {command}" for command in missing.commands]
    if report is not None:
        lines += ["", f"written to {report}; read it before you give it to others"]
    return lines


def _verdict(evidence: Evidence, found: Examination) -> Iterator[str]:
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
    yield from _wrapped(f"{verdict}  {style(f'({about})', dim=True)}", "", "")


def _finding(finding: Finding) -> Iterator[str]:
    sign, colour = _SIGNS[finding.severity]
    head = f"{style(f'{sign} {finding.area}', fg=colour, bold=True)}  {style(finding.what, bold=True)}"
    yield from _wrapped(head, "", "    ")
    for label, text in (
        ("where", finding.where),
        ("evidence", finding.evidence),
        ("do", finding.action),
    ):
        yield from _row(label, text)
    for command in finding.commands:
        yield f"{'':{_LABEL + 2}}{style('$ ' + command, fg='green')}"
    yield from _row("see", style(f"docs/{finding.see}", dim=True))


def _row(label: str, text: str, width: int = _LABEL) -> Iterator[str]:
    head = "  " + style(f"{label:<{width}}", dim=True)
    yield from _wrapped(head + text, "", " " * (width + 2))


def _wrapped(text: str, first: str, following: str) -> list[str]:
    """Lines of the width, counted without colours; what cannot be broken stays whole."""
    words = text.split(" ")
    lines = [first + words[0]]
    for word in words[1:]:
        if len(click.unstyle(lines[-1])) + 1 + len(click.unstyle(word)) <= _WIDTH:
            lines[-1] += f" {word}"
        else:
            lines.append(following + word)
    return lines
