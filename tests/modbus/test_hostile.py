"""Hostile devices: a moment of what ``tools/fuzz hostile_devices`` does for long."""

from __future__ import annotations

import pytest

from tests.modbus.hostile import FUZZED, fuzz


@pytest.mark.thorough
@pytest.mark.usefixtures("namespace")
@pytest.mark.parametrize("over_tcp", [False, True], ids=["rtu", "tcp"])
@pytest.mark.parametrize("name", FUZZED)
def test_hostile_devices(name: str, over_tcp: bool) -> None:
    found = fuzz(FUZZED[name](), 100_000, 5, over_tcp=over_tcp)
    assert found["updates"] > 100
    assert min(found[kind] for kind in ("good", "exception", "other", "damaged", "cut", "noise")) > 5
