"""Every test gets a namespace of its own, and must leave nothing behind."""

from __future__ import annotations

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

from skinware.memory.namespace import Namespace

# other things run beside the tests: how long an example takes says nothing
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
os.environ.setdefault("SKINWARE_TEST_PATIENCE", "5")  # read when the first test module asks for it

# what a shell runs in the background ignores Ctrl-C, and so would all that the tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def everywhere(namespace: Namespace) -> None:
    """Also where no test asks for it."""
