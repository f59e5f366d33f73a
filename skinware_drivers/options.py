"""Options that people write as text: bus queries and command lines become typed, checked structs.

An options class is a ``msgspec.Struct`` whose fields carry a description, so that commands can print it::

    class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        boards: Annotated[tuple[int, ...], msgspec.Meta(description="board addresses")] = (7, 8)

Lists are written with commas, whole numbers also as ranges: ``7,8,9`` or ``7-9``; and any of them as ``0x710``.
"""

from __future__ import annotations

import difflib
import re
import types
from collections.abc import Iterable, Mapping
from typing import (
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError

OptionsT = TypeVar("OptionsT", bound=msgspec.Struct)

_HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]+")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
_LONGEST_RANGE = 1 << 16
_ASKED = {"bool": "yes or no", "int": "a whole number", "float": "a number", "str": "a text"}
_KINDS = {bool: "yes/no", int: "INTEGER", float: "NUMBER", str: "TEXT"}


class Option(NamedTuple):
    """One option of an options class, as a command shows it."""

    name: str
    kind: str
    """What to write: ``INTEGER``, ``NUMBER``, ``TEXT``, ``INTEGER,...``, ``a|b|c`` or ``yes/no``."""
    required: bool
    default: str
    """The default as a person would write it; empty where nothing stands for it."""
    description: str


class HasOptions(Generic[OptionsT]):
    """What is made from options, whose class the base has in brackets: ``class Thumb(CanAdapter[ThumbOptions])``.

    Args:
        options: an object of that class.

    Attributes:
        Options: that class.
        options: as given.
        period_s: nominal time between two sets of data, s; options with a field ``period_ms`` set it.

    Raises:
        ConfigurationError: when a subclass is made: what stands in its brackets is no class of options.
    """

    Options: ClassVar[type[msgspec.Struct]]
    least_options: ClassVar[type[msgspec.Struct]] = msgspec.Struct
    """What the class of the options must be derived from."""
    period_s: float = 0.02

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        named = _in_brackets(cls)
        if isinstance(named, TypeVar):  # a subclass will say
            return
        if not (isinstance(named, type) and issubclass(named, cls.least_options)):
            least = f"{cls.least_options.__module__}.{cls.least_options.__name__}"
            raise ConfigurationError(
                f"class {cls.__name__}: its base has {getattr(named, '__name__', named)} in brackets, where"
                f" the class of its options belongs, derived from {least}"
            )
        if not issubclass(cls.Options, named):
            if "Options" in vars(cls):
                raise ConfigurationError(
                    f"class {cls.__name__}: Options = {cls.Options.__name__} contradicts the {named.__name__} that"
                    " its base has in brackets: leave out the line"
                )
            cls.Options = named

    def __init__(self, options: OptionsT) -> None:
        self.options = options
        period_ms = getattr(options, "period_ms", 0)
        if period_ms:
            self.period_s = period_ms / 1000


def _in_brackets(cls: Any) -> Any:
    """The options' class that a subclass of HasOptions names, or has from its base; a TypeVar if neither does yet."""
    for base in vars(cls).get("__orig_bases__", cls.__bases__):
        origin: Any = get_origin(base) or base
        if origin is HasOptions:
            return get_args(base)[0]
        if issubclass(origin, HasOptions):
            inherited = _in_brackets(origin)
            return dict(zip(origin.__parameters__, get_args(base), strict=False)).get(inherited, inherited)
    return None


def describe_options(options_class: type[msgspec.Struct]) -> list[Option]:
    """The options of a class that can be written as text, in the order in which it declares them."""
    hints = get_type_hints(options_class, include_extras=True)
    return [
        Option(
            field.encode_name,
            _kind(_plain_type(hints[field.name])),
            field.required,
            "" if field.required else option_text(_default(field)),
            _description(hints[field.name]),
        )
        for field in msgspec.structs.fields(options_class)
        if not _is_table(_plain_type(hints[field.name]))
    ]


def options_from_strings(options_class: type[OptionsT], strings: Mapping[str, str]) -> OptionsT:
    """Make options from ``key=value`` texts.

    Args:
        options_class: the struct to make.
        strings: texts by option name. A yes/no option with an empty text is on.

    Raises:
        ConfigurationError: an option is unknown (the message gives the nearest right name), missing, or its
            text is not what the option takes.
    """
    fields = {field.encode_name: field for field in msgspec.structs.fields(options_class)}
    hints = get_type_hints(options_class, include_extras=True)
    values: dict[str, Any] = {}
    for name, text in strings.items():
        if name not in fields:
            raise ConfigurationError(f"unknown option {name!r}{nearest_name(name, fields)}")
        hint = hints[fields[name].name]
        try:
            values[fields[name].name] = msgspec.convert(_split(text, _plain_type(hint)), hint, strict=False)
        except (msgspec.ValidationError, ValueError) as error:
            raise ConfigurationError(f"option {name}={text}: {_reason(error)}") from None
    for name, field in fields.items():
        if field.required and field.name not in values:
            raise ConfigurationError(f"option {name!r} must be given")
    return options_class(**values)


def check_options(options: msgspec.Struct) -> None:
    """Hold every field against its type and limits; for ``__post_init__``, which msgspec's limits do not reach.

    Raises:
        ConfigurationError: a field has a value that its annotation does not allow.
    """
    hints = get_type_hints(type(options), include_extras=True)
    for field in msgspec.structs.fields(type(options)):
        value = getattr(options, field.name)
        try:
            msgspec.convert(value, hints[field.name])
        except msgspec.ValidationError as error:
            message = f"option {field.encode_name}={option_text(value)}: {_reason(error)}"
            raise ConfigurationError(message) from None


def option_text(value: Any) -> str:
    """A value as a person would write it in a bus query: ``7,8``, ``yes``, ``0.01``."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return ""
    if isinstance(value, list | tuple):
        return ",".join(option_text(item) for item in value)
    return str(value)


def nearest_name(wrong: str, right: Iterable[str]) -> str:
    """The end of an error message about an unknown name: the nearest right one, and all there are."""
    names = sorted(right)
    nearest = difflib.get_close_matches(wrong, names, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else "."
    return f"{hint} Known: {', '.join(names) or 'none'}"


def _split(text: str, plain: Any) -> Any:
    """A text as msgspec can convert it: lists split, ranges of whole numbers written out, words for yes and no."""
    if plain is bool:
        word = text.strip().lower()
        return {"": True, "yes": True, "on": True, "no": False, "off": False}.get(word, word)
    if plain is int:
        return _number(text.strip())
    if get_origin(plain) not in (list, tuple):
        return text.strip()
    items = [item.strip() for item in text.split(",") if item.strip()]
    if _plain_type(get_args(plain)[0]) is not int:
        return items
    numbers: list[str | int] = []
    for item in items:
        match = _RANGE.fullmatch(item)
        if match is None:
            numbers.append(_number(item))
            continue
        first, last = int(match[1]), int(match[2])
        if not 0 <= last - first < _LONGEST_RANGE:
            raise ValueError(f"the range {item} does not go upwards, or is too long")
        numbers.extend(range(first, last + 1))
    return numbers


def _number(text: str) -> str | int:
    """A whole number that is written as 0x710 too."""
    return int(text, 16) if _HEXADECIMAL.fullmatch(text) else text


def _plain_type(hint: Any) -> Any:
    """The type under ``Annotated`` and beside ``None``."""
    if get_origin(hint) is Annotated:
        return _plain_type(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        others = [other for other in get_args(hint) if other is not type(None)]
        return _plain_type(others[0]) if len(others) == 1 else hint
    return hint


def _is_table(plain: Any) -> bool:
    """Whether a type is a struct or a list of them, which only a configuration file can hold."""
    if get_origin(plain) in (list, tuple):
        return _is_table(_plain_type(get_args(plain)[0]))
    return isinstance(plain, type) and issubclass(plain, msgspec.Struct)


def _kind(plain: Any) -> str:
    if get_origin(plain) in (list, tuple):
        return f"{_kind(_plain_type(get_args(plain)[0]))},..."
    if get_origin(plain) is Literal:
        return "|".join(str(word) for word in get_args(plain))
    return _KINDS.get(plain, "TEXT")


def _description(hint: Any) -> str:
    if get_origin(hint) is Annotated:
        for meta in get_args(hint)[1:]:
            if isinstance(meta, msgspec.Meta) and meta.description:
                return meta.description
    return ""


def _default(field: msgspec.structs.FieldInfo) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def _reason(error: Exception) -> str:
    """What msgspec says, in words for people, without its path to a value that the message already names."""
    text = re.sub(r" - at `\$\[(\d+)\]`", lambda item: f" (number {int(item[1]) + 1} of the list)", str(error))
    asked = re.compile(r"Expected `(\w+)(.*?)`(?:, got `\w+`)?")
    return asked.sub(lambda match: f"give {_ASKED.get(match[1], match[1])}{match[2]}", text).replace("`", "")


__all__ = [
    "HasOptions",
    "Option",
    "check_options",
    "describe_options",
    "nearest_name",
    "option_text",
    "options_from_strings",
]
