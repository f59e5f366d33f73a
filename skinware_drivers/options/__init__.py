"""Options of drivers and emulators: declared as structs, written as text or TOML, checked."""

from skinware_drivers.options.declared import (
    HasOptions,
    NoOptions,
    Option,
    Options,
    OptionsT,
    check_names,
    describe_options,
    option_text,
    options_from_strings,
)

__all__ = [
    "HasOptions",
    "NoOptions",
    "Option",
    "Options",
    "OptionsT",
    "check_names",
    "describe_options",
    "option_text",
    "options_from_strings",
]
