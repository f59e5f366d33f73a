"""One stranger for all tests of a process: they share its environment, not its folders."""

from __future__ import annotations

import pytest

from tests.outside.stranger import Stranger
from tests.sharing import common_folder
from tests.wheel import built_wheel


@pytest.fixture(scope="session")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Stranger:
    folder, cache = tmp_path_factory.mktemp("stranger"), common_folder(tmp_path_factory) / "mypy_cache"
    return Stranger(folder, built_wheel(tmp_path_factory), cache)
