"""How the suite says what is wrong: in words, without a trace through its own code."""

from __future__ import annotations

from typing import NoReturn

import pytest


def defect(what: str) -> NoReturn:
    """Fail the test with a message that names the defect and what to look at."""
    pytest.fail(what, pytrace=False)


def require(condition: object, what: str) -> None:
    """Fail the test unless something holds."""
    if not condition:
        defect(what)
