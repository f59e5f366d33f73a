"""``skin-record`` beside another program: it ends, with its file complete, when that one closes its standard input."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading


def _end_with_input() -> None:
    sys.stdin.read()  # of a program that was killed, the kernel closes it
    os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        from skinware.cli.record import main

        main()
