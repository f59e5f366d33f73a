"""Damaged streams of devices behind servers: everything is counted, nothing is raised."""

from __future__ import annotations

import pytest

from tests.streams.fuzzing import DEVICES, fuzz


@pytest.mark.parametrize("name", DEVICES)
def test_damage_is_counted_and_never_raised(name: str) -> None:
    counters = fuzz(name, 700_000, seed=7)
    assert counters.frames > 50
    assert counters.framing.refused + counters.framing.checksum_errors > 50
