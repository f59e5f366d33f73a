"""Load drivers and emulators by name: registered by packages, or in a file of one's own."""

from __future__ import annotations

import importlib
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from importlib.util import find_spec
from types import ModuleType
from typing import Any, NamedTuple

import skinware
from skinware.errors import ConfigurationError
from skinware.memory.namespace import check_name
from skinware.text import nearest_name
from skinware_drivers.options import SOURCE_SUFFIX, is_file

_OURS = tuple(os.path.dirname(file) + os.sep for file in (__file__, skinware.__file__))
_PYTHONS, _INSTALLED = sysconfig.get_path("stdlib"), sysconfig.get_path("purelib")  # the second may lie in the first


class ClassKind(NamedTuple):
    """A kind of class that can be loaded.

    Attributes:
        word: its name for people: ``driver``.
        group: of entry points, in which packages register theirs.
        base: name of the class that authors subclass, for people.
        fits: returns whether a class is of this kind.
        instead: advice if a file has none, for people: the end of a sentence.
    """

    word: str
    group: str
    base: str
    fits: Callable[[type], bool]
    instead: str = ""


def load(kind: ClassKind, name: str) -> type[Any]:
    """Return the class of a name.

    A file's folder is put behind all others in which Python looks for modules: the file can import modules beside it,
    and none of them hides an installed one.

    Args:
        kind: of class.
        name: under which it is registered, or path of a file that ends in ``.py`` and defines one such class.

    Raises:
        ConfigurationError: there is none, or it cannot be loaded; the message has the reason, and the place in the
            author's code.
    """
    if is_file(name):
        return _class_in(name, kind)
    known = registered(kind.group)
    if name not in known:
        raise ConfigurationError(
            f"there is no {kind.word} {name!r}{nearest_name(name, sorted(known))}. One of yours: give its file, as"
            f" ./{name}{SOURCE_SUFFIX}, or install its package: pip install -e ."
        )
    entry = known[name]

    def is_theirs(file: str) -> bool:  # neither Python's nor of this package
        return not file.startswith(("<", *_OURS)) and (file.startswith(_INSTALLED) or not file.startswith(_PYTHONS))

    with _blamed(f"{kind.word} {name!r} ({entry.value})", is_theirs):
        loaded = entry.load()
    if not (isinstance(loaded, type) and kind.fits(loaded)):
        raise ConfigurationError(f"{kind.word} {name!r}: {entry.value} is no subclass of {kind.base} or its like")
    return loaded


def registered(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in _selection(tuple(sys.path))(group=group)}


@cache
def _selection(_path: tuple[str, ...]) -> Callable[..., EntryPoints]:
    """Return the selection from the entry points of all packages on Python's path; their files are read once."""
    return entry_points().select


def short_name(name: str) -> str:
    """Return a name as people see it: a file without its folder and ending."""
    return os.path.basename(name).removesuffix(SOURCE_SUFFIX) if is_file(name) else name


def _class_in(name: str, kind: ClassKind) -> type[Any]:
    module = _module_of(name, kind)
    classes = dict.fromkeys(thing for thing in vars(module).values() if isinstance(thing, type))
    found = [one for one in classes if one.__module__ == module.__name__ and kind.fits(one)]
    if not found:
        raise ConfigurationError(
            f"{name} has no {kind.word}: it defines no subclass of {kind.base} or its like (imported ones do not count)"
            f"{kind.instead}"
        )
    if len(found) > 1:
        names = ", ".join(one.__name__ for one in found)
        raise ConfigurationError(
            f"{name} has {len(found)} {kind.word}s: {names}; leave one of them in it, and import what it needs of the"
            " others from a file beside it"
        )
    return found[0]


def _module_of(name: str, kind: ClassKind) -> ModuleType:
    """Return the module in a file; it has the name by which modules beside it import it, and is imported once."""
    path = os.path.abspath(name)
    if not os.path.isfile(path):
        raise ConfigurationError(f"{kind.word} {name}: there is no such file")
    folder, own_name = os.path.dirname(path), check_name(short_name(path), f"{name}: {kind.word}")
    if folder not in sys.path:
        sys.path.append(folder)
    importlib.invalidate_caches()  # the file may be new
    spec = find_spec(own_name)
    origin = "" if spec is None or spec.origin is None else spec.origin
    if os.path.realpath(origin) != os.path.realpath(path):
        raise ConfigurationError(
            f"{name}: there is another Python module {own_name!r} already ({origin}); give the file another name"
        )
    with _blamed(f"{kind.word} {name}", lambda file: os.path.dirname(file) == folder):
        return importlib.import_module(own_name)


@contextmanager
def _blamed(what: str, is_theirs: Callable[[str], bool]) -> Iterator[None]:
    """Report what fails in an author's code, with the last place in the author's own files."""
    try:
        yield
    except (Exception, SystemExit) as error:
        text = str(error)
        trace = traceback.extract_tb(error.__traceback__)
        places = [f"{at.filename}:{at.lineno}" for at in trace if is_theirs(at.filename)]
        if isinstance(error, SyntaxError):
            text, places = error.msg, [f"{error.filename}:{error.lineno}"]
        where = f" ({places[-1]})" if places else ""
        raise ConfigurationError(f"{what} cannot be loaded: {type(error).__name__}: {text}{where}") from error
