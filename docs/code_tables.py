"""Directives for tables that the code already has: ``settings``, ``members``, ``columns`` and ``catalogue``.

``settings CLASS`` shows the fields of a class with their defaults, ``members ENUM`` the members of an enumeration,
``columns KIND`` the columns of a kind of service, from its form, ``catalogue NAME`` the sensor types of a dictionary.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from typing import Any

import msgspec
import numpy as np
from docutils import nodes
from docutils.statemachine import StringList
from json_fields import meanings
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from skinware.service import Column
from skinware.tactile.contacts_service import ContactsReader
from skinware.tactile.health_service import HealthReader
from skinware.tactile.motion import MotionReader
from skinware.tactile.source_service import Source

FORMS = {reader.form.kind: reader.form for reader in (ContactsReader, MotionReader, HealthReader)}
_SOURCE = Source("", unit="that of the values", regions=("",), uid=np.zeros(1, np.uint64))


def settings(name: str) -> Iterator[str]:
    """Yield the lines of a table of a class' fields."""
    cls = _named(name)
    yield from ("| setting | default | meaning |", "|---|---|---|")
    for field, meaning in meanings(cls).items():
        yield f"| `{field}` | {_shown(_defaults(cls)[field])} | {meaning.replace('null', 'None')} |"


def members(name: str) -> Iterator[str]:
    """Yield the lines of a table of an enumeration's members."""
    cls = _named(name)
    texts = meanings(cls)
    yield from ("| number | name | meaning |", "|---|---|---|")
    for member, text in texts.items():
        yield f"| {getattr(cls, member).value} | `{member}` | {text} |"


def columns(service: str) -> Iterator[str]:
    """Yield the lines of a table of a service's columns."""
    yield from ("| column | dtype and shape | unit | meaning |", "|---|---|---|---|")
    for name, column in FORMS[service].columns(_SOURCE)[0].items():
        yield f"| `{name}` | {_form(column)} | {column.unit} | {column.description} |"


def catalogue(name: str) -> Iterator[str]:
    """Yield the lines of a table of sensor types."""
    yield from ("| number | name | unit |", "|---|---|---|")
    for one in _named(name).values():
        yield f"| {one.id} | `{one.name}` | {one.unit} |"


def _shown(default: Any) -> str:
    return "" if default is MISSING else f"{default:g}" if isinstance(default, float) else str(default)


def _form(column: Column) -> str:
    return f"{column.dtype} {column.shape[1:]}" if column.shape[1:] else str(column.dtype)


def _named(name: str) -> Any:
    module, _, own = name.rpartition(".")
    return getattr(import_module(module), own)


def _defaults(cls: type) -> dict[str, Any]:
    if is_dataclass(cls):
        return {field.name: field.default for field in fields(cls)}
    return {field.name: field.default for field in msgspec.structs.fields(cls)}


TABLES = {"settings": settings, "members": members, "columns": columns, "catalogue": catalogue}


class CodeTable(SphinxDirective):
    """Show the table of this directive's name."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        lines = TABLES[self.name](self.arguments[0])
        found = nodes.container()
        rows = StringList(list(lines), source=self.get_source_info()[0])
        self.state.nested_parse(rows, self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    for name in TABLES:
        app.add_directive(name, CodeTable)
    return {"parallel_read_safe": True}
