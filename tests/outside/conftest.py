"""One stranger for all tests of a process: they share its environment, not its folders."""

from __future__ import annotations

import pytest

from tests.outside.stranger import Stranger


@pytest.fixture(scope="session")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Stranger:
    return Stranger(tmp_path_factory.mktemp("stranger"))
