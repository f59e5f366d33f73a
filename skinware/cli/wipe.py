"""``skin-wipe``: a hand goes over the whole skin; which sensors never answered?"""

from __future__ import annotations

import contextlib
import math
import sys
from typing import TYPE_CHECKING

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    EXIT_DONE,
    EXIT_FAILED,
    examples,
    json_option,
    namespace_option,
    run,
    seconds,
    version_option,
)
from skinware.cli._terminal import echo, overwrite, print_json
from skinware.text import count_text, figure_text, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    import numpy.typing as npt

    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot

_TELL_EVERY_S = 1.0


@click.command(
    "skin-wipe",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-wipe left_hand              wipe over the whole hand; Ctrl-C when you have been everywhere",
        "skin-wipe left_hand -T 60 --json for programs",
    ),
)
@click.argument("name", required=False)
@click.option("--type", "type_name", metavar="TYPE", help="Sensors to test.  [default: the driver's first type]")
@click.option("-T", "duration_s", type=seconds, help="End after SECONDS.")
@namespace_option
@json_option
@version_option
@click.pass_context
def command(
    context: click.Context,
    name: str | None,
    type_name: str | None,
    duration_s: float | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Wipe test of driver NAME, or of the only one: which sensors never answer?

    Leave the skin alone for the first second, then press your way over all of it. The test ends when every sensor has
    answered, with Ctrl-C, or after SECONDS, and lists those that never did. Sensors that are switched off do not count.

    Exit status: 0 every sensor answered, 1 some never did or the driver failed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace
    from skinware.views.driver_snapshots import reader_of

    with reader_of(Namespace(namespace), name, "skin-wipe NAME") as reader:
        wipe = _Wipe(reader, type_name, as_json)
        with contextlib.suppress(KeyboardInterrupt):
            wipe.go_on(duration_s)
        context.exit(EXIT_DONE if wipe.tell_result() else EXIT_FAILED)


class _Wipe:
    """A wipe test and what is said of it.

    Args:
        reader: of the driver.
        type_name: which sensors; None: of its first type.
        as_json: how to tell.
    """

    def __init__(self, reader: DriverReader, type_name: str | None, as_json: bool) -> None:
        import numpy as np

        from skinware.views.history import Rest, WipeTest

        self._reader, self._as_json = reader, as_json
        self._structure = reader.structure
        self._type = self._structure.types[0] if type_name is None else self._structure.type(type_name)
        self._rest, self._test = Rest(self._structure), WipeTest(self._structure)
        self._status = np.zeros(self._structure.n_sensors, np.uint8)
        self._is_redrawing = not as_json and sys.stdout.isatty()

    def go_on(self, duration_s: float | None) -> None:
        from skinware.views.driver_snapshots import after
        from skinware.views.history import SETTLING_S, threshold

        resting = None
        for frame, physical in self._frames(SETTLING_S):
            self._rest.follow(physical, frame.status == 0, frame.published_ns)
            resting = physical, frame.status == 0
        if resting is not None:
            self._test.follow(*resting)  # the first press may be there before the next snapshot
        needed = threshold(self._rest.noise(self._type.name))
        told = {"driver": self._reader.name, "type": self._type.name, "unit": self._type.unit, "threshold": needed}
        if self._as_json:
            print_json({"event": "ready", **told, "sensors": self._n_tested})
        else:
            more = f"more than {figure_text(needed, 3)} {self._type.unit}".rstrip()
            tested = plural(self._n_tested, f"{self._type.name} sensor")
            echo(f"{self._reader.name}: press your way over {tested}, {more} each (Ctrl-C ends)")
        is_due = after(_TELL_EVERY_S)
        for frame, physical in self._frames(duration_s):
            self._test.follow(physical, frame.status == 0)
            is_complete = not len(self._never_answered())
            if is_complete or is_due():
                is_due = after(_TELL_EVERY_S)
                self._tell_progress()
            if is_complete:
                return

    def tell_result(self) -> bool:
        """List what never answered; whether everything did."""
        never = self._never_answered().tolist()
        answered = self._n_tested - len(never)
        named = [
            {
                "name": self._structure.sensor_name(position),
                "uid": int(self._structure.sensor_uid[position]),
                "position": position,
                "status": int(self._status[position]),
            }
            for position in never
        ]
        if self._as_json:
            print_json({"event": "done", "answered": answered, "sensors": self._n_tested, "never": named})
        else:
            echo("\n" * self._is_redrawing + self._progress() + (", never:" if never else ""))
            for one in named:
                echo(f"  {one['name']}{self._why(one['status'])}")
        return not never

    @property
    def _n_tested(self) -> int:
        return len(self._tested())

    def _tested(self) -> npt.NDArray[np.int64]:
        import numpy as np

        from skinware.status import Status

        positions = np.arange(self._structure.n_sensors)[self._structure.index(self._type.name)]
        tested: npt.NDArray[np.int64] = positions[(self._status[positions] & np.uint8(Status.MASKED)) == 0]
        return tested

    def _never_answered(self) -> npt.NDArray[np.int64]:
        import numpy as np

        never = self._test.never_moved(self._type.name, self._rest.noise(self._type.name))
        return never[np.isin(never, self._tested())]

    def _frames(self, duration_s: float | None) -> Iterator[tuple[DriverSnapshot, npt.NDArray[np.float32]]]:
        """Frames with their physical values, (n_sensors,); 0 for sensors of other types."""
        from skinware.views.driver_snapshots import after, frames_until, physical_of

        for frame in frames_until(self._reader, after(math.inf if duration_s is None else duration_s)):
            self._status = frame.status
            yield frame, physical_of(frame, self._type.name)

    def _progress(self) -> str:
        answered = self._n_tested - len(self._never_answered())
        return f"{count_text(answered)} of {count_text(self._n_tested)} answered"

    def _tell_progress(self) -> None:
        if self._as_json:
            answered = self._n_tested - len(self._never_answered())
            print_json({"event": "wiping", "answered": answered, "sensors": self._n_tested})
        elif self._is_redrawing:
            overwrite(self._progress())
        else:
            echo(self._progress())

    def _why(self, status: int) -> str:
        from skinware.status import Status

        said = ", ".join(str(bit.name).lower().replace("_", " ") for bit in Status if status & bit)
        return f" ({said})" if said else ""


def main() -> None:
    run(command)
