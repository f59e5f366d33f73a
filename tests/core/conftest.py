"""Processes and users for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from skinware import Namespace
from tests.core import workers
from tests.core.users import Users, running_driver


@pytest.fixture(scope="module")
def process_server() -> Iterator[None]:
    """Child processes start quickly while it runs."""
    with workers.process_server():
        yield


@pytest.fixture
def users(
    tmp_path: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch, process_server: None
) -> Iterator[Users]:
    """The owner's driver ``x`` runs; others may do what they can."""
    with running_driver(tmp_path, monkeypatch) as made:
        yield made
