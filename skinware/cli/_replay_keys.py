"""The terminal of ``skin-replay``: keys that control it, and a line that shows where it is."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from skinware.cli._format import terminal_width
from skinware.cli._terminal import echo, overwrite

if TYPE_CHECKING:
    from skinware.recording.replaying import Replayer

KEYS = "space: pause   . , : a frame on, back   arrows: 5 s, 1 min   + - 1: speed   l: loop   0: begin   q: end"
_KEY = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Z]|[^\x1b]", re.DOTALL)
_BAR = 20


class Terminal:
    """Keys and the line. Without a terminal, or in the background of one, there are none.

    Args:
        replayer: what the keys control.
    """

    def __init__(self, replayer: Replayer) -> None:
        self._replayer = replayer
        self._before: list[object] | None = None
        self._calls: dict[bytes, Callable[[], object]] = {
            b" ": self._toggle_pause,
            b".": lambda: replayer.step(1),
            b",": lambda: replayer.step(-1),
            b"\x1b[C": lambda: replayer.seek(replayer.time_s + 5),
            b"\x1b[D": lambda: replayer.seek(replayer.time_s - 5),
            b"\x1b[A": lambda: replayer.seek(replayer.time_s + 60),
            b"\x1b[B": lambda: replayer.seek(replayer.time_s - 60),
            b"+": lambda: replayer.speed(replayer.replay()["speed"] * 2),
            b"-": lambda: replayer.speed(replayer.replay()["speed"] / 2),
            b"1": lambda: replayer.speed(1.0),
            b"l": lambda: replayer.loop(not replayer.replay()["loop"]),
            b"0": lambda: replayer.seek(0.0),
            b"q": replayer.stop,
        }

    @property
    def is_ours(self) -> bool:
        """Whether the keys are told to us: there is a terminal, and we are in its foreground."""
        streams = (sys.stdin, sys.stdout)
        if not all(stream is not None and stream.isatty() for stream in streams):
            return False
        with contextlib.suppress(OSError):
            return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
        return False

    @contextlib.contextmanager
    def keys(self) -> Iterator[None]:
        self.take()
        try:
            yield
        finally:
            self._give_back()

    def take(self) -> None:
        """Hear keys from now on, if that is possible; again after a stop (SIGCONT)."""
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
        told = self._replayer.replay()
        share = min(1.0, told["time_s"] / told["duration_s"]) if told["duration_s"] else 1.0
        bar = "=" * round(share * _BAR)
        words = [
            f"{clock(told['time_s'])} / {clock(told['duration_s'])}",
            f"[{bar:<{_BAR}}]",
            f"x{told['speed']:g}",
            *["paused"] * told["paused"],
            *["loop"] * told["loop"],
            *[f"{told['late']} late"] * bool(told["late"]),
        ]
        return "  ".join(words)[: max(0, width - 1)]

    def _give_back(self) -> None:
        self._replayer.unwatch(0)
        if self._before is not None and self.is_ours:
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)  # type: ignore[arg-type]
            echo()

    def _hear(self) -> None:
        try:
            told = os.read(sys.stdin.fileno(), 256)
        except OSError:
            told = b""
        if not told:  # hung up
            self._replayer.unwatch(sys.stdin.fileno())
            return
        for key in _KEY.findall(told):
            self._calls.get(key.replace(b"\x1bO", b"\x1b["), lambda: None)()
        self.draw()

    def _toggle_pause(self) -> None:
        (self._replayer.resume if self._replayer.replay()["paused"] else self._replayer.pause)()


def clock(time_s: float) -> str:
    """``1:02.3``, ``1:00:02.3``."""
    tenths = round(time_s * 10)
    minutes, rest = divmod(tenths, 600)
    hours, of_hour = divmod(minutes, 60)
    return f"{hours}:{of_hour:02}:{rest / 10:04.1f}" if hours else f"{of_hour}:{rest / 10:04.1f}"
