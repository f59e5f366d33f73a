"""A push runs every test of the suite for one driver of each transport, and the quick ones for the others."""

from __future__ import annotations

import pytest

WHOLE = ("TestBarrett", "TestAbilityHand", "TestTesollo", "TestFlexiTac")
"""Classes for which a push runs all: CAN, serial with answers, TCP, serial alone."""
LONG = (
    "test_a_damaged_frame_costs_its_own_burst_only",
    "test_a_listener_sends_nothing",
    "test_both_data_paths_do_the_same",
    "test_it_can_be_stopped_at_any_moment",
    "test_memory_does_not_grow",
    "test_nothing_is_valid_before_the_first_data",
    "test_nothing_leaks",
    "test_nothing_torn_is_shown_while_a_sender_stumbles",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        owner = getattr(item, "cls", None)
        if owner is not None and item.originalname in LONG and owner.__name__ not in WHOLE:  # type: ignore[attr-defined]
            item.add_marker(pytest.mark.thorough)
