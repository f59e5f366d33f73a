"""Every test gets a namespace of its own, and must leave nothing behind; a push runs few drivers through all tests."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, Phase, settings

from skinware.memory.namespace import Namespace
from skinware_drivers.testing.plugin import files_left

# other things run beside the tests: how long an example takes says nothing
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
settings.register_profile(
    "unshrunk", settings.get_profile("busy"), phases=[Phase.explicit, Phase.generate], database=None
)  # that a test fails is all that tools/mutate asks
os.environ.setdefault("SKINWARE_TEST_PATIENCE", "5")  # read when the first test module asks for it
os.environ.setdefault("PYTHONFAULTHANDLER", "1")  # a command that dies of a signal says where it was

WHOLE = ("TestBarrett", "TestAbilityHand", "TestArray", "TestTesollo", "TestFlexiTac")
"""Drivers for which a push runs the whole suite: CAN, serial with answers, Modbus, TCP, serial alone."""
LONG = (
    "test_a_damaged_frame_costs_its_own_burst_only",
    "test_a_dead_device_holds_up_no_other",
    "test_a_listener_sends_nothing",
    "test_a_lost_bus_comes_back",
    "test_both_data_paths_do_the_same",
    "test_devices_that_come_late_are_found",
    "test_foreign_frames_disturb_nothing",
    "test_it_can_be_stopped_at_any_moment",
    "test_memory_does_not_grow",
    "test_no_run_of_lost_frames_tears_a_burst",
    "test_nothing_is_valid_before_the_first_data",
    "test_nothing_leaks",
    "test_nothing_torn_is_shown_while_a_sender_stumbles",
    "test_silence_is_shown_and_ends",
)
"""Tests of the suite that a push leaves out for the other drivers."""

# what a shell runs in the background ignores Ctrl-C, what nohup runs a hangup, and so would all that the tests start
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        owner = getattr(item, "cls", None)
        if owner is not None and item.originalname in LONG and owner.__name__ not in WHOLE:  # type: ignore[attr-defined]
            item.add_marker(pytest.mark.thorough)


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
