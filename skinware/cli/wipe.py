"""``skin-wipe``: find sensors that never answer while a hand goes over the whole skin."""

from __future__ import annotations

import contextlib
import math
import sys
from functools import partial
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, overwrite, print_json, say
from skinware.text import count_text, measure_text, plural, status_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    import numpy.typing as npt

    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot

_REPORT_EVERY_S = 1.0


@cli.command(
    "skin-wipe",
    "skin-wipe left_hand              wipe over the whole hand; Ctrl-C when you have been everywhere",
    "skin-wipe left_hand -T 60 --json for programs",
)
@click.argument("name", required=False)
@cli.type_option("Sensors to test.  [default: normal force or pressure, else another touch]")
@cli.duration_option()
@cli.namespace_option
@cli.json_option
@click.pass_context
def command(
    context: click.Context,
    name: str | None,
    type_name: str | None,
    duration_s: float | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Find the sensors of driver NAME, or of the only one, that never answer.

    Leave the skin alone for the first second, then press your way over all of it. The test ends when every sensor has
    answered, with Ctrl-C, or after SECONDS, and lists those that never did. Sensors that are switched off do not count.

    Exit status: 0 every sensor answered, 1 some never did or the driver failed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace
    from skinware.views.live import reader_of

    with reader_of(Namespace(namespace), name, "skin-wipe NAME") as reader:
        wipe = _Wipe(reader, type_name, as_json)
        with contextlib.suppress(KeyboardInterrupt):
            wipe.go_on(duration_s)
        context.exit(cli.EXIT_DONE if wipe.report_result() else cli.EXIT_FAILED)


class _Wipe:
    def __init__(self, reader: DriverReader, type_name: str | None, as_json: bool) -> None:
        import numpy as np

        from skinware.views.history import DriverRest, WipeTest
        from skinware.views.quantities import types_of

        self._reader, self._as_json = reader, as_json
        self._structure = reader.structure
        self._type = types_of(self._structure)[0] if type_name is None else self._structure.type(type_name)
        self._rest, self._test = DriverRest(self._structure), WipeTest(self._structure)
        self._status = np.zeros(self._structure.n_sensors, np.uint8)
        self._is_redrawing = not as_json and sys.stdout.isatty()

    def go_on(self, duration_s: float | None) -> None:
        from skinware.views.history import SETTLING_S, threshold
        from skinware.views.live import after

        resting = None
        for frame, physical in self._frames(SETTLING_S):
            self._rest.follow(physical, frame.status == 0, frame.published_ns)
            resting = physical, frame.status == 0
        if resting is not None:
            self._test.follow(*resting)  # the first press may be there before the next snapshot
        needed = threshold(self._rest.noise(self._type.name))
        what = {"driver": self._reader.name, "type": self._type.name, "unit": self._type.unit}
        more = f"more than {measure_text(needed, self._type.unit, 3)}"
        tested = self._count()[0]
        ready = {"event": "ready", **what, "threshold": needed, "sensors": tested}
        sensors = plural(tested, f"{self._type.name} sensor")
        say(self._as_json, ready, f"{self._reader.name}: press your way over {sensors}, {more} each (Ctrl-C ends)")
        is_due = after(_REPORT_EVERY_S)
        for frame, physical in self._frames(duration_s):
            self._test.follow(physical, frame.status == 0)
            tested, never = self._count()
            if not never or is_due():
                is_due = after(_REPORT_EVERY_S)
                answered = tested - len(never)
                text = f"{count_text(answered)} of {count_text(tested)} answered"
                if self._is_redrawing:
                    overwrite(text)
                else:
                    say(self._as_json, {"event": "wiping", "answered": answered, "sensors": tested}, text)
            if not never:
                return

    def report_result(self) -> bool:
        tested, never = self._count()
        answered = tested - len(never)
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
            print_json({"event": "done", "answered": answered, "sensors": tested, "never": named})
        else:
            text = f"{count_text(answered)} of {count_text(tested)} answered"
            echo("\n" * self._is_redrawing + text + (", never:" if never else ""))
            for position in never:
                status = int(self._status[position])
                why = f" ({status_text(status)})" if status else ""
                echo(f"  {self._structure.sensor_name(position)}{why}")
        return not never

    def _count(self) -> tuple[int, list[int]]:
        """Return how many sensors are tested, and the positions of those that have not answered so far."""
        import numpy as np

        from skinware.status import Status

        is_tested = (self._status & np.uint8(Status.MASKED)) == 0
        never = self._test.never_moved(self._type.name, self._rest.noise(self._type.name))
        return int(is_tested[self._structure.index(self._type.name)].sum()), never[is_tested[never]].tolist()

    def _frames(self, duration_s: float | None) -> Iterator[tuple[DriverSnapshot, npt.NDArray[np.float32]]]:
        """Yield snapshots with their (n_sensors,) physical values."""
        from skinware.views.live import after, frames_until

        for frame in frames_until(self._reader, after(math.inf if duration_s is None else duration_s)):
            self._status = frame.status
            yield frame, frame.physical_values()


main = partial(cli.run, command)
