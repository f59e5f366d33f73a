"""Read the file that says what the fields of topics mean (docs/drivers/ros2.md), and guess one of a message."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import msgspec

from skinware.errors import ConfigurationError
from skinware.ros_types import Definitions
from skinware.text import nearest_name
from skinware.toml_text import TomlText
from skinware_drivers.streams.cdr import CdrMessage
from skinware_drivers.streams.ros2_parts import FieldRule, Making, by_rules
from skinware_drivers.streams.ros2_presets import PRESETS, TEXTS

_FORMAT, _VERSION = "skinware-ros2-map", 1
_NOT_SHOWN = re.compile(r"(^|\.)(header|stamp|\w*stamp|time|seq|id|\w*_id|index)(\.|$)")
_COUNTING = ("seq", "sequence", "sequence_number", "header.seq")
_AXES = re.compile(r"(.*[._])?([xyz])")


class _MapTopic(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    type: str
    values: tuple[FieldRule, ...] = ()


class _TopicMapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    topic: tuple[_MapTopic, ...]
    definition: dict[str, str] = {}


def read_map(path: str) -> list[tuple[str, Definitions, Making]]:
    """Return names of topics, with the definitions of their types and what makes parts of their messages.

    Raises:
        ConfigurationError: the file cannot be read, or says something that cannot be; the message says where.
    """
    text = TomlText(Path(path))
    file = text.of_format("map of topics", _FORMAT, _VERSION, _TopicMapFile)
    texts = {**TEXTS, **file.definition}
    found = []
    for number, topic in enumerate(file.topic):
        try:
            definitions = Definitions(topic.type, texts)
            making = by_rules(*topic.values) if topic.values else preset(topic.type)
        except ConfigurationError as error:
            raise ConfigurationError(f"{text.place(('topic', number, 'type'))}: {error}") from None
        found.append((topic.name, definitions, making))
    return found


def preset(type_name: str) -> Making:
    """Return what makes parts of messages of a type.

    Raises:
        ConfigurationError: the type is not known.
    """
    if type_name not in PRESETS:
        raise ConfigurationError(
            f"messages {type_name!r} are not known{nearest_name(type_name, sorted(PRESETS))}; their fields need a map"
        )
    return PRESETS[type_name]


def texts_of(type_name: str, folder: str) -> Definitions:
    """Return definitions of a type and all that are in it: known ones, and files ``PACKAGE/msg/NAME.msg``.

    Args:
        folder: of packages; those of an installed ROS 2 (``AMENT_PREFIX_PATH``) are looked through, too.

    Raises:
        ConfigurationError: one is missing.
    """
    texts = dict(TEXTS)
    folders = [Path(folder)] if folder else []
    folders += [Path(each) / "share" for each in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if each]
    while True:
        try:
            return Definitions(type_name, texts)
        except ConfigurationError as error:
            missing = re.search(r"definition of type (\S+) is missing", str(error))
            if missing is None:
                raise
            package, _, name = missing[1].rpartition("/")
            files = [path for each in folders if (path := each / package / "msg" / f"{name}.msg").is_file()]
            if not files:
                raise ConfigurationError(
                    f"{error}: give a folder with {package}/msg/{name}.msg (definitions=FOLDER), or source the ROS 2"
                    " that has it"
                ) from None
            texts[missing[1]] = files[0].read_text(encoding="utf-8", errors="replace")


def guessed(topic: str, type_name: str, message: CdrMessage, definitions: Definitions) -> str:
    """Return a map of a message: a module for each field of numbers; x, y and z are values of the same taxels."""
    lines = [f'format = "{_FORMAT}"', f"version = {_VERSION}", "", "[[topic]]", f'name = "{topic}"']
    lines += [f'type = "{type_name}"']
    for rule in [] if type_name in PRESETS else _rules(message):
        lines += ["", "[[topic.values]]"]
        for key, value in msgspec.to_builtins(rule).items():
            if value not in ("", None):
                lines.append(f"{key} = {msgspec.json.encode(value).decode()}")
    unknown = {name: text for name, text in definitions.texts.items() if name not in TEXTS}
    lines += ["", "[definition]"] if unknown else []
    for name, text in unknown.items():
        lines.append(f'"{name}" = """\n{text}"""')
    return "\n".join(lines) + "\n"


def _rules(message: CdrMessage) -> Iterator[FieldRule]:
    of_axes: dict[str, list[str]] = {}
    number = next((name for name in _COUNTING if name in message.numbers), "")
    for name in message.numbers:
        if _NOT_SHOWN.search(name):
            continue
        match = _AXES.fullmatch(name)
        of_axes.setdefault(match[1] or "" if match else name, []).append(name)
    for group, names in of_axes.items():
        count = sum(numbers.length for numbers in message.numbers[names[0]].values())
        if not count:
            continue
        module = group.rstrip("._").replace(".", " ") or "values"
        if len(names) == 3:
            yield FieldRule(tuple(names), ("force_x", "force_y", "force_z"), module=module, taxels=count, number=number)
        else:
            for name in names:
                own = module if len(names) == 1 else name.replace(".", " ")
                yield FieldRule(name, module=own, taxels=count, number=number)
