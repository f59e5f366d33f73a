"""A slow machine must not make a driver of these tests look silent."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import Structure
from skinware import state as health


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "_LEAST_SILENCE_NS", 10**15)
    monkeypatch.setattr(Structure, "age_limits_ns", lambda self, _: np.full(self.n_sensors, 10**15))
