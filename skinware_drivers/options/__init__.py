"""Options of drivers and emulators: declared as structs, written as text or TOML, checked."""

from skinware_drivers.options.declared import HasOptions, NoOptions, Option, check_names, describe_options
from skinware_drivers.options.texts import OptionsT, check_options, nearest_name, option_text, options_from_strings

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
