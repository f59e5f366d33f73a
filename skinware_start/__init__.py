"""Start a command so that Ctrl-C ends it in silence even before its modules are imported.

An entry point names the function of a command here: ``skinware_start:skinware.cli.info.main``.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module


def _end(_number: int, _frame: object) -> None:
    os._exit(128 + signal.SIGINT)  # the interpreter would print where the import stopped


class _Function:
    """A function whose module is imported when it is called."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __getattr__(self, name: str) -> _Function:
        return _Function(f"{self._path}.{name}")

    def __call__(self) -> None:
        before = signal.getsignal(signal.SIGINT)
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, _end)
        for stream, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
            if getattr(sys, stream) is None:  # started with it closed: another file would get its descriptor
                setattr(sys, stream, open(os.devnull, mode))  # noqa: SIM115
        module, _, name = self._path.rpartition(".")
        function = getattr(import_module(module), name)
        signal.signal(signal.SIGINT, before)
        function()


skinware, skinware_drivers = _Function("skinware"), _Function("skinware_drivers")
