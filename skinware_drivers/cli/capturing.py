"""Capture a driver and its wires in one file, and take driver and options from such a file."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from skinware.recording.recorder import Recorder
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


_END_S = 30.0
"""Longest time to complete the file."""


class Capture:
    """A recorder in a process of its own; ``result`` has ``bytes``, ``missed`` and ``problem`` after the end."""

    def __init__(self, path: Path, driver: str, namespace: str) -> None:
        self.path = path
        self.result: dict[str, Any] = {"bytes": 0, "missed": 0, "problem": "something else ended the recorder"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(path), driver, namespace],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C ends the driver first, so that its last words are in the file
        )
        try:
            begun = self._next()
        except BaseException:  # such as Ctrl-C
            self.end()
            raise
        if not begun.get("ready"):
            self.end()
            raise ConfigurationError(f"{path}: {begun.get('problem', 'nothing can be recorded')}")

    def end(self) -> None:
        if self._process.stdin is None or self._process.stdin.closed:
            return
        self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        self._process.kill()  # of no effect where it has ended
        self._process.wait()
        self.result |= self._next()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _next(self) -> dict[str, Any]:
        line = self._process.stdout.readline() if self._process.stdout is not None else ""
        return dict(json.loads(line)) if line else {}


@contextmanager
def captured(path: Path, driver: str, namespace: str, on_end: Callable[[Capture], None]) -> Iterator[Capture]:
    """Capture a driver while a block runs; start it inside. ``on_end`` is called when the file is complete."""
    capture = Capture(path, driver, namespace)
    try:
        yield capture
    finally:
        capture.end()
        on_end(capture)


def _record(path: Path, driver: str, namespace: str) -> None:
    from skinware.errors import SkinwareError

    problem, size, missed = "", 0, 0
    try:
        from skinware.recording.files import Files
        from skinware.recording.recorder import Recorder
        from skinware_drivers.doctor.report import Disguise

        target = Files(path)
        recorder = Recorder(target, names=[driver], namespace=namespace, with_wires=True, disguise=Disguise())
        threading.Thread(target=_end_with_input, args=(recorder,), daemon=True).start()
        _say(ready=True)
        try:
            recorder.run()
        finally:
            size, missed = target.size, recorder.missed
    except FileExistsError:
        problem = "exists already: give another name, or remove it"
    except (OSError, SkinwareError) as error:
        problem = getattr(error, "strerror", None) or str(error)
        if size:  # the driver may go on for hours
            print(f"{path}: ended early: {problem}; the driver goes on", file=sys.stderr)  # noqa: T201
    _say(problem=problem, bytes=size, missed=missed)


def _end_with_input(recorder: Recorder) -> None:
    os.read(0, 1)
    recorder.stop()


def _say(**what: Any) -> None:
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(what), flush=True)  # noqa: T201 - to the program that began this one


if __name__ == "__main__":
    _record(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
