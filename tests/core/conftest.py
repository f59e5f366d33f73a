"""Processes, users and compiled programs for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from skinware import Namespace
from tests.compiling import compiled
from tests.core import workers
from tests.core.c_programs import SOURCE
from tests.core.users import Users, running_driver
from tests.specification.ring import use_specification


@pytest.fixture(scope="module")
def process_server(request: pytest.FixtureRequest) -> Iterator[None]:
    """Child processes start quickly while it runs."""
    with workers.process_server(request.module.__name__):
        yield


@pytest.fixture
def users(
    tmp_path: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch, process_server: None
) -> Iterator[Users]:
    """The owner's driver ``x`` runs; others may do what they can."""
    with running_driver(tmp_path, monkeypatch) as made:
        yield made


@pytest.fixture(params=["c99", "c++11", "sanitized"])
def any_program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """c_reader.c, compiled in each way."""
    return compiled(SOURCE, request.param, tmp_path_factory)


@pytest.fixture
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """c_reader.c, compiled."""
    return compiled(SOURCE, "c99", tmp_path_factory)


@pytest.fixture(params=["ring", "specification"])
def ring(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The ring of the package, then its specification in Python; also in processes that a test starts."""
    if request.param == "specification":
        use_specification(monkeypatch)
    return str(request.param)
