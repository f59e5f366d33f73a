"""What tests of a module share."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def made() -> dict[str, bytes]:
    """Recordings that the first test makes that needs one."""
    return {}
