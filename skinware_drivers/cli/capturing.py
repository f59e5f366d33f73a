"""Capture a driver and its wires in one file, and take driver and options from such a file."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from skinware_drivers.virtual.recorded import Recorded


def driver_of_recording(bus_names: Sequence[str]) -> str:
    return next((it.driver_type for it in map(_recorded, bus_names) if it is not None and it.driver_type), "")


def only_listened(bus_names: Sequence[str]) -> bool:
    """Return whether all buses are replayed, and were recorded by drivers that sent nothing, or are logs of that."""
    found = [_recorded(name) for name in bus_names]
    return bool(found) and all(recorded is not None and recorded.listen_only for recorded in found)


def options_of_recording(bus_name: str, driver_type: str) -> Mapping[str, Any]:
    recorded = _recorded(bus_name)
    return recorded.options if recorded is not None and recorded.driver_type == driver_type else {}


def _recorded(bus_name: str) -> Recorded | None:
    if not bus_name.startswith(("replay:", "file:")):
        return None
    from skinware_drivers.virtual.recorded import recorded_driver

    return recorded_driver(bus_name)


_RECORD = ("-m", "skinware.cli.record", "--until-eof", "--wire", "--json")
_DISGUISE = "skinware_drivers.doctor.report:Disguise"
_END_S = 30.0
"""Longest time in which a program may end in good order."""


class EventProgram:
    """A program beside this one, in Python, which prints events as JSON.

    It has a session of its own: Ctrl-C ends this program first, which then ends the other one.

    Attributes:
        events: the newest one of each kind, by its name.
    """

    def __init__(self, arguments: Sequence[str], ends_by: signal.Signals | None = None) -> None:
        self.events: dict[str, dict[str, Any]] = {}
        self._ends_by, self._begun = ends_by, threading.Event()
        self._process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def is_ready(self, timeout_s: float | None = None) -> bool:
        """Wait until it is ready or has ended; return whether it is ready."""
        self._begun.wait(timeout_s)
        return "ready" in self.events

    def close(self) -> None:
        """Close its standard input, send it a signal if one ends it, and wait for its end. Idempotent."""
        process = self._process
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018 - they are pipes
        process.stdin.close()
        if self._ends_by is not None:
            process.send_signal(self._ends_by)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        process.kill()  # of no effect where it has ended
        process.wait()
        self._thread.join()
        process.stdout.close()

    def _listen(self) -> None:
        for line in self._process.stdout or ():
            with contextlib.suppress(ValueError, TypeError, KeyError):  # code of others may print something else
                event = dict(json.loads(line))
                self.events[event["event"]] = event
            if "ready" in self.events:
                self._begun.set()
        self._begun.set()


@contextmanager
def captured(
    path: Path, driver: str, namespace: str, on_end: Callable[[dict[str, Any]], object]
) -> Iterator[dict[str, Any]]:
    """Capture a driver while a block runs; start it inside. ``on_end`` gets the result when the file is complete.

    Yields:
        The result: at the end, ``bytes``, ``missed`` and ``problem``.
    """
    if path.exists():
        raise ConfigurationError(f"{path}: exists already: give another name, or remove it")
    what = (driver, "-o", str(path), "--namespace", namespace, "--disguise", _DISGUISE)
    with contextlib.closing(EventProgram([*_RECORD, *what])) as recorder:
        if not recorder.is_ready():
            raise ConfigurationError(f"{path}: nothing can be recorded")
        result: dict[str, Any] = {"bytes": 0, "missed": 0, "problem": "something else ended the recorder"}
        try:
            yield result
        finally:
            recorder.close()
            ended = recorder.events.get("stopped", {})
            result |= {name: ended[name] for name in result if name in ended}
            on_end(result)
