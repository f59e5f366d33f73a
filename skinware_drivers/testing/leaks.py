"""Find what a test leaves behind: descriptors, threads, processes, files."""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
from pathlib import Path


class Belongings:
    """The threads, descriptors and processes of this process at one moment."""

    def __init__(self) -> None:
        gc.freeze()  # makes the collection after each test fast: older objects are not searched
        self._threads = set(threading.enumerate())
        self._descriptors = _descriptors()

    def left_since(self) -> list[str]:
        """Return in words what was made since then and still exists."""
        gc.collect()
        gc.unfreeze()
        left = [f"thread {thread.name!r}" for thread in set(threading.enumerate()) - self._threads]
        left += [f"descriptor {number} ({target})" for number, target in sorted(_descriptors() - self._descriptors)]
        left += [f"process {process.name}" for process in multiprocessing.active_children()]
        return left


def files_left(namespace: Path) -> list[str]:
    """Return in words the files of services and readers that are left in a namespace."""
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
