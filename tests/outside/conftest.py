"""One stranger for all tests of a process: they share its environment, not its folders."""

from __future__ import annotations

import pytest

from tests.outside.stranger import Stranger


@pytest.fixture(scope="session")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Stranger:
    common = tmp_path_factory.getbasetemp().parent  # of all processes of pytest-xdist
    return Stranger(tmp_path_factory.mktemp("stranger"), common / "mypy_cache")
