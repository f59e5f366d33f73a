"""The directive ``json-fields CLASS PREFIX -FIELD``: the keys of a printed object, from its class and the docstrings.

``{json-fields} skinware_drivers.finding.ports.SerialPort ports[].`` is a table of its fields as keys ``ports[].path``
..., with their types in JSON; an array stands for one of its elements. Fields with a ``-`` are left out.
"""

from __future__ import annotations

import ast
import enum
import inspect
import re
import textwrap
import types
from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from itertools import pairwise
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", Any: "any"}


def json_fields(name: str, *words: str) -> list[str]:
    """Return the lines of a table in Markdown."""
    module, _, cls = name.rpartition(".")
    prefix = "".join(word for word in words if not word.startswith("-"))
    rows = _rows(getattr(import_module(module), cls), prefix)
    found = [row for row in rows if f"-{row[0]}" not in words]
    return [
        "| key | type | meaning |",
        "|---|---|---|",
        *(f"| `{key}` | {kind} | {meaning} |" for _, key, kind, meaning in found),
    ]


def _rows(cls: type, prefix: str) -> Iterator[tuple[str, str, str, str]]:
    texts = meanings(cls)
    for field, hint in get_type_hints(cls, include_extras=False).items():
        key, kind, inner = _json_type(prefix + field, hint)
        if inner is None or kind:
            yield field, key, kind, texts.get(field, "")
        if inner is not None:
            yield from ((field, *row[1:]) for row in _rows(inner, f"{key}."))


def _json_type(key: str, hint: Any) -> tuple[str, str, type | None]:
    """Return the key, its type (none: it only leads to others) and the class of its own keys."""
    if hasattr(get_origin(hint), "__value__"):  # an alias with parameters, as NDArray is from numpy 2.5 on
        return _json_type(key, get_origin(hint).__value__[get_args(hint)])
    if get_origin(hint) is Annotated:
        return _json_type(key, get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        (one,) = (part for part in get_args(hint) if part is not type(None))
        key, kind, inner = _json_type(key, one)
        return key, f"{kind or 'object'} or null", inner
    if get_origin(hint) is np.ndarray:  # one element of it
        element = get_args(get_args(hint)[1])[0]
        return key, "number or null" if issubclass(element, np.floating) else "integer", None
    if get_origin(hint) in (list, tuple):
        return _json_type(f"{key}[]", get_args(hint)[0])
    if get_origin(hint) is dict:
        return _json_type(f"{key}.NAME", get_args(hint)[1])
    if is_dataclass(hint) or (isinstance(hint, type) and issubclass(hint, msgspec.Struct)):
        return key, "", hint
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return key, "string", None
    return key, _PLAIN.get(hint, "string"), None


def meanings(cls: type) -> dict[str, str]:
    """Return the texts of a class' fields or members, from its docstring's section or their own docstrings."""
    found: dict[str, str] = {}
    section = inspect.getdoc(cls).partition("Attributes:\n")[2].partition("\n\n")[0]  # type: ignore[union-attr]
    for names, text in re.findall(r"^([\w, ]+): (.*(?:\n +.*)*)", textwrap.dedent(section), re.MULTILINE):
        found |= dict.fromkeys(names.split(", "), text)
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body  # type: ignore[attr-defined]
    for field, text in pairwise(body):
        if isinstance(field, ast.AnnAssign | ast.Assign) and isinstance(text, ast.Expr):
            target = field.target if isinstance(field, ast.AnnAssign) else field.targets[0]
            found[ast.unparse(target)] = ast.literal_eval(text.value)
    return {field: _as_markdown(text) for field, text in found.items()}


def _as_markdown(text: str) -> str:
    text = re.sub(r"^\([\w, ]+\) \w+, ", "", " ".join(text.split()))  # shape and dtype
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`").replace("|", "\\|")
    return re.sub(r"\b(None|True|False)\b", lambda match: {"None": "null"}.get(match[1], match[1].lower()), text)


class JsonFields(SphinxDirective):
    """Show the keys of a printed object."""

    required_arguments = 1
    optional_arguments = 9

    def run(self) -> list[nodes.Node]:
        found = nodes.container()
        rows = StringList(json_fields(*self.arguments), source=self.get_source_info()[0])
        self.state.nested_parse(rows, self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("json-fields", JsonFields)
    return {"parallel_read_safe": True}
