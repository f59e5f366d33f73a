"""Options of drivers and emulators: declared as structs, made from texts, described for commands.

The fields of an options class carry a description::

    class ThumbOptions(Options, frozen=True):
        boards: Annotated[tuple[int, ...], msgspec.Meta(description="board addresses")] = (7, 8)
"""

from __future__ import annotations

import re
import types
from collections.abc import Collection, Mapping, Set
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
from skinware.text import nearest_name

SOURCE_SUFFIX = ".py"


def is_file(name: str) -> bool:
    """Return whether a name is that of a file, not of something that is registered."""
    return name.endswith(SOURCE_SUFFIX)


OptionsT = TypeVar("OptionsT", bound=msgspec.Struct)

_HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]+")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
_LONGEST_RANGE = 1 << 16
_ASKED = {"bool": "yes or no", "int": "a whole number", "float": "a number", "str": "a text"}


def options_from_strings(
    options_class: type[OptionsT], strings: Mapping[str, str], beside: Collection[str] = ()
) -> OptionsT:
    """Return options made from texts.

    Args:
        options_class: the struct to make.
        strings: texts by name of option. A yes/no option with an empty text is on.
        beside: further names of options, for the message.

    Raises:
        ConfigurationError: an option is unknown (the message suggests the nearest name), missing, or has a wrong text.
    """
    fields = {field.encode_name: field for field in msgspec.structs.fields(options_class)}
    hints = get_type_hints(options_class, include_extras=True)
    values: dict[str, Any] = {}
    for name, text in strings.items():
        if name not in fields:
            raise ConfigurationError(f"unknown option {name!r}{nearest_name(name, sorted([*fields, *beside]))}")
        hint = hints[fields[name].name]
        try:
            values[fields[name].name] = msgspec.convert(_split(text, plain_type(hint)), hint, strict=False)
        except (msgspec.ValidationError, ValueError) as error:
            raise ConfigurationError(f"option {name}={text}: {_reason(error, hint)}") from None
    for name, field in fields.items():
        if field.required and field.name not in values:
            raise ConfigurationError(f"option {name!r} must be given")
    return options_class(**values)


def options_of(kind: Any, values: Mapping[str, Any]) -> Any:
    """Return the options of a driver or an emulator, a class with ``Options``, made from values.

    Raises:
        ConfigurationError: an option is unknown, missing, or has a wrong value.
    """
    try:
        return msgspec.convert(dict(values), kind.Options, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"options of {kind.__name__}: {error}") from None


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of options: a new object checks every field, which msgspec does not; with more checks, call ``super()``.

    Raises:
        ConfigurationError: a field has a value that its annotation does not allow.
    """

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for field in msgspec.structs.fields(type(self)):
            value = getattr(self, field.name)
            try:
                msgspec.convert(value, hints[field.name])
            except msgspec.ValidationError as error:
                message = f"option {field.encode_name}={option_text(value)}: {_reason(error, hints[field.name])}"
                raise ConfigurationError(message) from None


def option_text(value: Any) -> str:
    """Return a value as a person would write it in the name of a bus: ``7,8``, ``yes``, ``0.01``."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return ""
    if isinstance(value, list | tuple):
        return ",".join(option_text(item) for item in value)
    return str(value)


def plain_type(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return plain_type(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        others = [other for other in get_args(hint) if other is not type(None)]
        return plain_type(others[0]) if len(others) == 1 else hint
    return hint


def _split(text: str, plain: Any) -> Any:
    """Return a text in a form that msgspec can convert: lists are split, ranges of numbers expanded, yes is True."""
    if plain is bool:
        word = text.strip().lower()
        return {"": True, "yes": True, "on": True, "no": False, "off": False}.get(word, word)
    if plain is int:
        return _number(text.strip())
    if get_origin(plain) not in (list, tuple):
        return text.strip()
    items = [item.strip() for item in text.split(",") if item.strip()]
    if plain_type(get_args(plain)[0]) is not int:
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
    """Return a whole number, which may be written as 0x710."""
    return int(text, 16) if _HEXADECIMAL.fullmatch(text) else text


def _reason(error: Exception, hint: Any) -> str:
    """Return an error of msgspec in words for people, without the path to a value that the message names."""
    text = re.sub(r" - at `\$\[(\d+)\]`", lambda item: f" (number {int(item[1]) + 1} of the list)", str(error))
    text = re.sub(r" \| null(?=`)", "", text)
    plain = plain_type(hint)
    one = plain_type(get_args(plain)[0]) if get_origin(plain) in (list, tuple) else plain
    if get_origin(one) is Literal:
        words = ", ".join(map(str, get_args(one)))
        return re.sub(r"Invalid enum value [^ ]+|Expected `.*?`(?:, got `\w+`)?", f"give one of {words}", text)
    asked = re.compile(r"Expected `(\w+)(.*?)`(?:, got `\w+`)?")
    return asked.sub(lambda match: f"give {_ASKED.get(match[1], match[1])}{match[2]}", text).replace("`", "")


_KINDS = {bool: "yes/no", int: "INTEGER", float: "NUMBER", str: "TEXT"}


class NoOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a driver that has none."""


class Option(NamedTuple):
    """One option of an options class, as a command shows it."""

    name: str
    kind: str
    """The form of its text: ``INTEGER``, ``NUMBER``, ``TEXT``, ``INTEGER,...``, ``a|b|c`` or ``yes/no``."""
    required: bool
    default: str
    """The default as a person would write it; empty if there is no text for it."""
    description: str


class HasOptions(Generic[OptionsT]):
    """An object that is made from options; the base names their class: ``class Thumb(CanAdapter[ThumbOptions])``.

    Args:
        options: an object of that class.

    Attributes:
        Options: that class.
        options: as given.
        period_s: nominal time between two sets of data, s; options with a field ``period_ms`` set it.

    Raises:
        ConfigurationError: when a subclass is defined: its brackets have no class of options, or the command that takes
            the options has one of the same name.
    """

    Options: ClassVar[type[msgspec.Struct]]
    least_options: ClassVar[type[msgspec.Struct]] = msgspec.Struct
    """The base class of the options' class."""
    options_command: ClassVar[str] = ""
    """The command that takes the options as flags, beside its own."""
    reserved_options: ClassVar[Set[str]] = frozenset()
    """Names of the command's own options."""
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
        check_names(cls.Options, cls.reserved_options, cls.options_command, f"class {cls.__name__}")

    def __init__(self, options: OptionsT) -> None:
        self.options = options
        period_ms = getattr(options, "period_ms", 0)
        if period_ms:
            self.period_s = period_ms / 1000


def _in_brackets(cls: Any) -> Any:
    """Return the options' class that a subclass of HasOptions names or inherits; a TypeVar if it has none yet."""
    for base in vars(cls).get("__orig_bases__", cls.__bases__):
        origin: Any = get_origin(base) or base
        if origin is HasOptions:
            return get_args(base)[0]
        if issubclass(origin, HasOptions):
            inherited = _in_brackets(origin)
            return dict(zip(origin.__parameters__, get_args(base), strict=False)).get(inherited, inherited)
    return None


def check_names(options_class: type[msgspec.Struct], reserved: Set[str], command: str, owner: str) -> None:
    """Refuse options that the command line cannot carry.

    Args:
        options_class: the options.
        reserved: names of the command's own options.
        command: the command that takes both.
        owner: the owner of the options, for the message.

    Raises:
        ConfigurationError: an option has the name of one of the command's own.
    """
    for name in options_class.__struct_encode_fields__:
        if name.replace("-", "_") in reserved:
            raise ConfigurationError(
                f"{owner}: its option {name!r} would be hidden by --{name.replace('_', '-')} of {command}:"
                f" give it another name, such as 'device_{name}'"
            )


def describe_options(options_class: type[msgspec.Struct]) -> list[Option]:
    """Return the options of a class that can be written as text, in the order of their declaration."""
    hints = get_type_hints(options_class, include_extras=True)
    found = []
    for field in msgspec.structs.fields(options_class):
        hint = hints[field.name]
        plain = plain_type(hint)
        if _is_table(plain):
            continue
        default = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        metas = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        description = next((m.description for m in metas if isinstance(m, msgspec.Meta) and m.description), "")
        text = "" if field.required else option_text(default)
        found.append(Option(field.encode_name, _kind(plain), field.required, text, description))
    return found


def _is_table(plain: Any) -> bool:
    """Return whether a type is a struct or a list of them, which only a configuration file can hold."""
    if get_origin(plain) in (list, tuple):
        return _is_table(plain_type(get_args(plain)[0]))
    return isinstance(plain, type) and issubclass(plain, msgspec.Struct)


def _kind(plain: Any) -> str:
    if get_origin(plain) in (list, tuple):
        return f"{_kind(plain_type(get_args(plain)[0]))},..."
    if get_origin(plain) is Literal:
        return "|".join(str(word) for word in get_args(plain))
    return _KINDS.get(plain, "TEXT")
