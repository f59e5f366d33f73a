"""``skin-replay``: publish a recording again, or with ``--wire`` send its frames on buses."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.cli.replay import NAMESPACE, publish_again
from skinware.limits import SLOWEST_REPLAY

if TYPE_CHECKING:
    from skinware.recording import Recording
    from skinware_drivers.bus import Bus
    from skinware_drivers.virtual.logs import WireSource
    from skinware_drivers.virtual.recorded_wire import RecordedWire

_LONGEST_SLEEP_S = 0.05
_FULL_S = 0.1
"""Longest wait for a bus that takes no frame, before the frame is dropped."""
_PAYLOAD = 64


def speed_text(text: str) -> float:
    """Return a factor; for ``click.option(type=...)``."""
    factor = cli.seconds(text)
    if factor < SLOWEST_REPLAY:
        raise click.BadParameter(f"a speed is at least {SLOWEST_REPLAY}: 1 is the speed of the recording.")
    return factor


@cli.command(
    "skin-replay",
    "skin-replay walk.mcap                         skin-top --namespace replay shows it",
    "skin-replay walk.mcap torso --speed 0.5       one driver, half as fast",
    "skin-replay walk.mcap --start 10 --end 12 --loop",
    "skin-replay walk.mcap --paused                step through it with . and ,",
    "skin-replay walk.mcap --wire --bus vcan0      the frames on the recorded bus, for any program",
)
@click.argument("file", type=cli.FILE)
@cli.names_argument
@click.option("--speed", type=speed_text, default="1", metavar="X", help="2: twice as fast.")
@click.option("--start", "start_s", type=cli.seconds, default="0", metavar="SECONDS", help="Begin there.")
@click.option("--end", "end_s", type=cli.seconds, metavar="SECONDS", help="End there.")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--paused", is_flag=True, help="Wait for a key or a request first.")
@click.option("--stay", "stays", is_flag=True, help="Pause at the end, instead of ending.")
@click.option(
    "--times",
    type=click.Choice(["now", "recorded"]),
    default="now",
    help="Times of samples: moved to now, which keeps their ages, or as recorded.",
)
@click.option(
    "--namespace",
    metavar="NAME",
    help=f"Namespace to publish in.  [default: $SKINWARE_NAMESPACE, else '{NAMESPACE}', if nothing runs there]",
)
@cli.json_option
@click.option("--wire", is_flag=True, help="Send the recorded frames of buses on a --bus instead.")
@click.option(
    "--bus",
    "buses",
    metavar="[RECORDED=]BUS",
    multiple=True,
    help="With --wire: bus to send on; with several recorded buses, which one: can0=vcan0; may be repeated.",
)
def command(
    file: Path,
    names: tuple[str, ...],
    times: str,
    namespace: str | None,
    as_json: bool,
    wire: bool,
    buses: tuple[str, ...],
    **pace: Any,
) -> None:
    """Publish the drivers and services of a recording, or only NAME..., as if they ran now.

    They have the recorded names, structures, states and counters, and restart where they restarted. In a terminal, keys
    pause, step, seek and change the speed. Other programs call the same operations of any of the services: pause,
    resume, step, seek, speed, loop, replay.

    Exit status: 0 ended or interrupted, 1 failed, 2 wrong usage.
    """
    if wire:
        cli.refuse_others("--wire", {"file", "names", "speed", "start_s", "end_s", "loop", "as_json", "buses"})
        if not buses:
            raise click.UsageError(
                f"--wire needs a --bus, as vcan0; for a driver without one: skin-driver --bus replay:{file}"
            )
        _replay_wires(file, names, buses, pace, as_json)
        return
    if buses:
        raise click.UsageError("--bus needs --wire")
    publish_again(file, names, namespace, {**pace, "keeps_times": times == "recorded"}, as_json)


def _replay_wires(
    file: Path, drivers: Sequence[str], buses: Sequence[str], pace: Mapping[str, Any], as_json: bool
) -> None:
    import skinware.recording

    with skinware.recording.open(file) as recording:
        pairs = _pairs(recording, drivers, buses)
        sender = WireSender(pairs, pace["speed"], pace["start_s"], pace["end_s"])
        with contextlib.closing(sender), cli.signals_end(sender.stop):
            sender.open()
            names = {wire.bus: bus.name.removeprefix("bus ") for wire, bus in pairs}
            if as_json:
                print_json({"event": "ready", "file": str(file), "buses": names, "duration_s": recording.duration_s})
            else:
                echo(f"{file}: {', '.join(f'{one} on {other}' for one, other in names.items())} (Ctrl-C ends)")
            sender.send_all(loop=pace["loop"])
        for problem in recording.problems:
            cli.warn(problem)
    if as_json:
        print_json({"event": "stopped", "frames": dict(sender.sent), "failed": sender.failed})
    else:
        failed = f", {sender.failed} not taken by their bus" if sender.failed else ""
        echo(f"{sender.sent.total()} frames sent{failed}")


def _pairs(recording: Recording, drivers: Sequence[str], buses: Sequence[str]) -> list[tuple[WireSource, Bus]]:
    from skinware.errors import ConfigurationError
    from skinware.wire import MOST_BYTES
    from skinware_drivers.registry import make_bus
    from skinware_drivers.virtual.recorded import wire_of

    driver = drivers[0] if len(drivers) == 1 else ""
    pairs: list[tuple[WireSource, Bus]] = []
    for text in buses:
        names_one = any(text.startswith(f"{wire.bus}=") for wire in recording.wires)
        recorded, _, name = text.partition("=") if names_one else ("", "", text)
        wire = wire_of(recording, recorded, driver)
        if any(wire is other for other, _ in pairs):
            raise ConfigurationError(f"--bus {text}: {wire.bus} is sent already")
        pairs.append((wire, make_bus(name, payload_size=MOST_BYTES if wire.is_serial else _PAYLOAD)))
    return pairs


class WireSender:
    """Send recorded frames on buses, at their recorded times.

    Args:
        pairs: recorded wires, and unopened buses to send them on.
        speed: 2.0: twice as fast.
        end_s: end, in seconds of the recording; None: with the last frame.

    Attributes:
        sent: number of frames, or reads of a serial line, of each recorded bus.
        failed: number of those that a bus did not take.
    """

    def __init__(
        self,
        pairs: Sequence[tuple[WireSource, Bus]],
        speed: float = 1.0,
        start_s: float = 0.0,
        end_s: float | None = None,
    ) -> None:
        self._pairs, self._speed, self._start_s, self._end_s = pairs, speed, start_s, end_s
        self._stopping = False
        self.sent: Counter[str] = Counter()
        self.failed: int = 0

    def open(self) -> None:
        for _, bus in self._pairs:
            bus.open()

    def close(self) -> None:
        for _, bus in self._pairs:
            bus.close()

    def stop(self) -> None:
        """End ``send_all``; from any thread, and from a signal handler."""
        self._stopping = True

    def send_all(self, *, loop: bool = False) -> None:
        """Send everything once, or in a loop until ``stop`` is called."""
        before = -1
        while not self._stopping and before < self.sent.total():  # an empty part is not looped
            before = self.sent.total()
            self._send_once()
            if not loop:
                break

    def _send_once(self) -> None:
        from skinware_drivers.virtual.recorded import first_of
        from skinware_drivers.virtual.recorded_wire import RecordedWire

        first_ns = first_of([wire for wire, _ in self._pairs], self._start_s)
        wires: list[tuple[str, Bus, RecordedWire]] = []
        for wire, bus in self._pairs:
            items = wire.items(start_s=self._start_s, end_s=self._end_s)
            wires.append((wire.bus, bus, RecordedWire(items, first_ns, speed=self._speed, waits=False)))
        begin_ns = time.monotonic_ns()
        for _, _, recorded in wires:
            recorded.skip(begin_ns)
        while not self._stopping:
            now_ns = time.monotonic_ns()
            due_now = [(frame, name, bus) for name, bus, recorded in wires for frame in recorded.emit(now_ns)]
            for frame, name, bus in sorted(due_now, key=lambda one: one[0].time_ns):
                self._send(name, bus, frame.identifier, frame.payload)
            dues = [due for _, _, recorded in wires if (due := recorded.next_due_ns()) is not None]
            if not dues:
                return
            time.sleep(min(max(0.0, (min(dues) - time.monotonic_ns()) / 1e9), _LONGEST_SLEEP_S))

    def _send(self, name: str, bus: Bus, identifier: int, payload: bytes) -> None:
        from skinware.errors import BusSendError

        give_up_s = time.monotonic() + _FULL_S
        while not self._stopping:
            try:
                bus.send(identifier, payload)
            except BusSendError:
                if time.monotonic() >= give_up_s:
                    self.failed += 1
                    return
                time.sleep(0.001)
            else:
                self.sent[name] += 1
                return


main = partial(cli.run, command, goes_on=True)
