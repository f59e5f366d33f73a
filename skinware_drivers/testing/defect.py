"""Fail a test in words, without a traceback through the suite."""

from __future__ import annotations

from typing import NoReturn

import pytest


def defect(what: str) -> NoReturn:
    """Fail the test with a message that names the defect and the place to look at."""
    pytest.fail(what, pytrace=False)


def require(condition: object, what: str) -> None:
    """Fail the test unless a condition holds."""
    if not condition:
        defect(what)
