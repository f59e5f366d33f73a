"""Options of drivers and emulators: declared as structs, written as text or TOML, checked."""

from skinware_drivers.options.declared import (
    HasOptions,
    NoOptions,
    Option,
    OptionsT,
    check_names,
    check_options,
    describe_options,
    nearest_name,
    option_text,
    options_from_strings,
)

__all__ = [
    "HasOptions",
    "NoOptions",
    "Option",
    "OptionsT",
    "check_names",
    "check_options",
    "describe_options",
    "nearest_name",
    "option_text",
    "options_from_strings",
]
