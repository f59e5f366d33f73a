"""What commands print: the one way of text to stdout, stderr and a terminal.

Names, units, descriptions and errors come from drivers, recordings, devices and robots of others. None of their
characters reaches a terminal unless it can be printed. Colours are the commands' own: no other text knows their number.
"""

from __future__ import annotations

import logging
import re
import secrets
from typing import Any

import click
import msgspec

from skinware._printable import printable

_OWN = str(secrets.randbelow(9 * 10**14) + 10**14)
_SGR = re.compile(r"\x1b\[([0-9;]*)m")
_OWN_SGR = re.compile(rf"(\x1b\[{_OWN};[0-9;]*m)")
_KEPT = "\n\t"


def style(text: str, **how: Any) -> str:
    """A text with colours, as :func:`click.style` has them; only :func:`echo` prints it."""
    return _SGR.sub(lambda found: f"\x1b[{_OWN};{found[1]}m", click.style(text, **how))


def shown(text: str) -> str:
    """A text as a terminal may have it: with the colours of :func:`style`, and without control characters of others."""
    parts = _OWN_SGR.split(text)
    parts[0::2] = [printable(part, _KEPT) for part in parts[0::2]]
    parts[1::2] = [part.replace(f"{_OWN};", "") for part in parts[1::2]]
    return "".join(parts)


def echo(text: str = "", *, nl: bool = True, err: bool = False) -> None:
    """Print a text, without colours where there is no terminal."""
    click.echo(shown(text), nl=nl, err=err)


def overwrite(text: str, *, err: bool = False) -> None:
    """Print a text in the place of the line on the terminal."""
    click.echo(f"\r{shown(text)}\x1b[K", nl=False, err=err, color=True)


def repaint(lines: list[str]) -> None:
    if click.get_current_context().color is False:
        lines = [click.unstyle(line) for line in lines]
    text = "".join(f"{shown(line)}\x1b[K\n" for line in lines)
    click.echo(f"\x1b[H{text}\x1b[J", nl=False, color=True)


def print_json(data: object) -> None:
    """One object on one line, at once. Numbers that JSON does not have (``nan``, ``inf``) become null."""
    click.echo(json_text(data))


def json_text(data: object) -> str:
    """An object as JSON; what cannot be printed is escaped in it, so that programs have it and terminals do not."""
    text = msgspec.json.encode(data).decode()
    return text if text.isprintable() else "".join(map(_escaped, text))


def _escaped(sign: str) -> str:
    if sign.isprintable():
        return sign
    units = sign.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))


class Formatter(logging.Formatter):
    """Lines of the log, for a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """See :class:`logging.Formatter`."""
        return shown(super().format(record))
