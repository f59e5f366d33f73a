"""Every test gets a namespace of its own, and must leave nothing behind."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from skinware.memory.namespace import Namespace
from skinware_drivers.testing.defect import files_left

# other things run beside the tests: how long an example takes says nothing
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
os.environ.setdefault("SKINWARE_TEST_PATIENCE", "5")  # read when the first test module asks for it
os.environ.setdefault("PYTHONFAULTHANDLER", "1")  # a command that dies of a signal says where it was

# what a shell runs in the background ignores Ctrl-C, and so would all that the tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def everywhere(namespace: Namespace) -> None:
    """Also where no test asks for it."""


@pytest.fixture
def calm_namespace(namespace: Namespace) -> Iterator[Namespace]:
    """A second namespace of this test, for what a service makes of the first; nothing may be left in it either."""
    place = Namespace(f"{namespace.name}-calm")
    yield place
    left = files_left(place.path)
    shutil.rmtree(place.path, ignore_errors=True)
    assert not left
