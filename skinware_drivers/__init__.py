"""The driver SDK: transport adapters, frame layouts, the runner, and the drivers that ship with it."""

import os


def get_include() -> str:
    """The folder of ``openpatch.h``, the microcontroller's side of the open patch protocol."""
    return os.path.join(os.path.dirname(__file__), "include")
