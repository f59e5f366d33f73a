"""Every test gets a namespace of its own, and must leave nothing behind."""

from __future__ import annotations

import pytest

from skinware.memory.namespace import Namespace
from skinware_drivers.testing.waiting import wait_until

__all__ = ["wait_until"]


@pytest.fixture(autouse=True)
def everywhere(namespace: Namespace) -> None:
    """Also where no test asks for it."""
