"""A slow machine must not make a driver of these tests look silent."""

from __future__ import annotations

import pytest

from skinware.views import health


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "_LEAST_SILENCE_NS", 10**15)
    monkeypatch.setattr(health, "age_limit_ns", lambda _: 10**15)
