"""Enter at the terminal, for commands that go on meanwhile."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator

_LOOK_S = 0.1


def is_there() -> bool:
    """Whether somebody can press it: there is a terminal."""
    return sys.stdin is not None and sys.stdin.isatty()


@contextlib.contextmanager
def pressed_calls(call: Callable[[], object]) -> Iterator[None]:
    """Enter calls something, in another thread, as long as the block lasts. Nothing without a terminal."""
    if not is_there():
        yield
        return
    ended = threading.Event()
    thread = threading.Thread(target=_listen, args=(sys.stdin.fileno(), call, ended), name="Enter", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _listen(fd: int, call: Callable[[], object], ended: threading.Event) -> None:
    while not ended.wait(_LOOK_S):
        with contextlib.suppress(OSError):  # the terminal is gone
            in_foreground = os.tcgetpgrp(fd) == os.getpgrp()  # who reads in the background is stopped
            if in_foreground and select.select([fd], [], [], 0)[0] and os.read(fd, 4096).endswith(b"\n"):
                call()
