"""Every test gets a namespace of its own, and must leave nothing behind."""

from __future__ import annotations

import gc
import multiprocessing
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, settings

from skinware.memory.namespace import Namespace

# other things run beside the tests: how long an example takes says nothing
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


def wait_until(condition: Callable[[], bool], deadline_s: float = 30.0) -> None:
    """Wait for a condition; fails the test if it does not come true in time."""
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, f"not within {deadline_s} s: {condition}"
        time.sleep(0.005)


@pytest.fixture(autouse=True)
def namespace(monkeypatch: pytest.MonkeyPatch) -> Iterator[Namespace]:
    """A fresh namespace, also for child processes; afterwards no process, thread, descriptor or file may be left."""
    monkeypatch.setenv("SKINWARE_NAMESPACE", f"test-{os.getpid()}-{secrets.token_hex(4)}")
    place = Namespace()
    gc.collect()
    threads, descriptors = set(threading.enumerate()), _descriptors()
    yield place
    gc.collect()
    try:
        left = [str(path) for path in place.path.rglob("*") if path.suffix != ".lock" and path != place.readers_path]
        assert not left, f"files left in shared memory: {left}"
        assert not multiprocessing.active_children(), "a process was left"
        assert set(threading.enumerate()) <= threads, "a thread was left"
        assert _descriptors() <= descriptors, f"descriptors left: {_descriptors() - descriptors}"
    finally:
        shutil.rmtree(place.path, ignore_errors=True)


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
