"""Publish a recording again, controlled by keys, for ``skin-replay``."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skinware.cli import _command as cli
from skinware.cli._terminal import are_terminals, echo, has_keys, overwrite, print_json, say, terminal_width
from skinware.errors import BadServiceFile, ConfigurationError, ServiceNotFound
from skinware.limits import SLOWEST_REPLAY

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace
    from skinware.recording.replaying import Replayer

KEYS = "space: pause   . , : a sample on, back   arrows: 5 s, 1 min   + - 1: speed   l: loop   0: begin   q: end"
_KEY = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Z]|[^\x1b]", re.DOTALL)
_BAR = 20


class Terminal:
    """The keys and the line of progress; without a terminal, or in its background, there are none."""

    def __init__(self, replayer: Replayer) -> None:
        self._replayer = replayer
        self._before: list[object] | None = None
        self._calls: dict[bytes, Callable[[], object]] = {
            b" ": lambda: (replayer.resume if replayer.replay()["paused"] else replayer.pause)(),
            b".": lambda: replayer.step(1),
            b",": lambda: replayer.step(-1),
            b"\x1b[C": lambda: replayer.seek(replayer.time_s + 5),
            b"\x1b[D": lambda: replayer.seek(replayer.time_s - 5),
            b"\x1b[A": lambda: replayer.seek(replayer.time_s + 60),
            b"\x1b[B": lambda: replayer.seek(replayer.time_s - 60),
            b"+": lambda: replayer.speed(replayer.replay()["speed"] * 2),
            b"-": lambda: replayer.speed(max(replayer.replay()["speed"] / 2, SLOWEST_REPLAY)),
            b"1": lambda: replayer.speed(1.0),
            b"l": lambda: replayer.loop(not replayer.replay()["loop"]),
            b"0": lambda: replayer.seek(0.0),
            b"q": replayer.stop,
        }

    @property
    def is_ours(self) -> bool:
        """Whether keys arrive here: there is a terminal, and this program is in its foreground."""
        return are_terminals(sys.stdout) and has_keys()

    @contextlib.contextmanager
    def keys(self) -> Iterator[None]:
        self.take()
        try:
            yield
        finally:
            self._replayer.unwatch(0)
            if self._before is not None and self.is_ours:
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)  # type: ignore[arg-type]
                echo()

    def take(self) -> None:
        """Read keys from now on, if that is possible; called again after a stop (SIGCONT)."""
        self._replayer.unwatch(0)
        if not self.is_ours:
            self._before = None
            return
        fd = sys.stdin.fileno()
        self._before = self._before or termios.tcgetattr(fd)
        tty.setcbreak(fd)
        self._replayer.watch(fd, self._hear)

    def draw(self) -> None:
        if self._before is not None and self.is_ours:
            overwrite(self.line(terminal_width() or 80))

    def line(self, width: int) -> str:
        state = self._replayer.replay()
        share = min(1.0, state["time_s"] / state["duration_s"]) if state["duration_s"] else 1.0
        bar = "=" * round(share * _BAR)
        words = [
            f"{clock(state['time_s'])} / {clock(state['duration_s'])}",
            f"[{bar:<{_BAR}}]",
            f"x{state['speed']:g}",
            *["paused"] * state["paused"],
            *["loop"] * state["loop"],
            *[f"{state['late']} late"] * bool(state["late"]),
        ]
        return "  ".join(words)[: max(0, width - 1)]

    def _hear(self) -> None:
        try:
            pressed = os.read(sys.stdin.fileno(), 256)
        except OSError:
            pressed = b""
        if not pressed:  # hung up
            self._replayer.unwatch(sys.stdin.fileno())
            return
        for key in _KEY.findall(pressed):
            self._calls.get(key.replace(b"\x1bO", b"\x1b["), lambda: None)()
        self.draw()


def clock(time_s: float) -> str:
    """Return a time as ``1:02.3`` or ``1:00:02.3``."""
    tenths = round(time_s * 10)
    minutes, rest = divmod(tenths, 600)
    hours, of_hour = divmod(minutes, 60)
    return f"{hours}:{of_hour:02}:{rest / 10:04.1f}" if hours else f"{of_hour}:{rest / 10:04.1f}"


NAMESPACE = "replay"
_DRAW_EVERY_S = 0.1


def publish_again(
    file: Path, names: Sequence[str], namespace: str | None, pace: Mapping[str, Any], as_json: bool
) -> None:
    """Publish the services of a recording until its end; ``pace``: arguments of :class:`Replayer`."""
    import skinware.recording
    from skinware.memory.namespace import Namespace
    from skinware.recording.replaying import Replayer

    place = Namespace(namespace or os.environ.get("SKINWARE_NAMESPACE") or NAMESPACE)
    _heed_others(place, is_chosen=bool(namespace))
    with skinware.recording.open(file) as recording:
        replayer = Replayer(recording, names=names or None, namespace=place, **pace)
        terminal = Terminal(replayer)
        is_steered = not as_json and terminal.is_ours
        continued = {signal.SIGCONT: terminal.take} if is_steered else {}
        with contextlib.closing(replayer), cli.signals_end(replayer.stop, continued):
            published = list(names or recording.services)
            ready: dict[str, Any] = {"event": "ready", "file": str(file), "namespace": place.name, "names": published}
            ready |= {"duration_s": recording.duration_s, "is_whole": recording.is_whole}
            ends = "" if recording.is_whole else " (cut off or damaged)"
            text = f"{file}, {recording.duration_s:.1f} s{ends}: {', '.join(published) or 'nothing'} in"
            say(as_json, ready, f"{text} namespace {place.name!r} (Ctrl-C ends)")
            if is_steered:
                echo(KEYS)
                with terminal.keys():
                    replayer.run(terminal.draw, _DRAW_EVERY_S)
            else:
                replayer.run(lambda: _report("status", replayer, as_json))
        for problem in recording.problems:
            cli.warn(problem)
    _report("stopped", replayer, as_json)


def _heed_others(place: Namespace, *, is_chosen: bool) -> None:
    """Keep recorded samples apart from living ones; only warn if the namespace was given as an option."""
    from skinware.service import ServiceReader

    living = []
    for name in place.services():
        with contextlib.suppress(BadServiceFile, ServiceNotFound):
            with ServiceReader[Any](name, namespace=place, announce=False) as reader:
                living += [name] if reader.alive else []
    run = f"{', '.join(living)} {'runs' if len(living) == 1 else 'run'}"
    if living and is_chosen:
        cli.warn(f"{run} in namespace {place.name!r} too: readers see living and recorded samples side by side")
    elif living:
        raise ConfigurationError(
            f"{run} in namespace {place.name!r}: give another one with --namespace, or"
            f" --namespace {place.name} to publish beside them"
        )


def _report(event: str, replayer: Replayer, as_json: bool) -> None:
    from skinware.text import plural

    with contextlib.suppress(BrokenPipeError):
        if as_json:
            print_json({"event": event, **replayer.replay(), "frames": dict(replayer.frames)})
        elif event == "stopped":
            late = f", {replayer.late} of them late" if replayer.late else ""
            echo(f"{plural(replayer.frames.total(), 'frame')} published{late}")
