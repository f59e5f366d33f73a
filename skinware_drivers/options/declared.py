"""Find the class of options that a driver or emulator declares, and describe its options for commands.

An options class is a ``msgspec.Struct`` whose fields carry a description::

    class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        boards: Annotated[tuple[int, ...], msgspec.Meta(description="board addresses")] = (7, 8)
"""

from __future__ import annotations

from collections.abc import Set
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware_drivers.options.texts import OptionsT, option_text, plain_type

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
    return [
        Option(
            field.encode_name,
            _kind(plain_type(hints[field.name])),
            field.required,
            "" if field.required else option_text(_default(field)),
            _description(hints[field.name]),
        )
        for field in msgspec.structs.fields(options_class)
        if not _is_table(plain_type(hints[field.name]))
    ]


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
