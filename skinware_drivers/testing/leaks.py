"""What a test leaves behind: descriptors, threads, processes, files in shared memory."""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
from pathlib import Path


class Belongings:
    """What this process has at one moment."""

    def __init__(self) -> None:
        gc.freeze()  # so that garbage is sought only among what comes after it: after every test, that takes its time
        self._threads = set(threading.enumerate())
        self._descriptors = _descriptors()

    def left_since(self) -> list[str]:
        """What has come since then and is still there, in words; empty if nothing is."""
        gc.collect()
        gc.unfreeze()
        left = [f"thread {thread.name!r}" for thread in set(threading.enumerate()) - self._threads]
        left += [f"descriptor {number} ({target})" for number, target in sorted(_descriptors() - self._descriptors)]
        left += [f"process {process.name}" for process in multiprocessing.active_children()]
        return left


def files_left(namespace: Path) -> list[str]:
    """Files of services and readers that nobody took away from a namespace."""
    return [f"file {path}" for path in namespace.rglob("*") if path.suffix != ".lock" and path != namespace / "readers"]


def _descriptors() -> set[tuple[str, str]]:
    found = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{number}")
        except FileNotFoundError:
            continue
        if not target.startswith(("/proc", "/dev/null", "pipe:[")):  # pytest's own capturing and multiprocessing's
            found.add((number, target))
    return found
