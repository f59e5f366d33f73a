"""What tests of a module share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.recording.rig import two_drivers_and_a_service
from tests.sdk.cable import Cable


@pytest.fixture(scope="module")
def made() -> dict[str, bytes]:
    """Recordings that the first test makes that needs one."""
    return {}


@pytest.fixture
def path(tmp_path: Path, made: dict[str, bytes]) -> Path:
    """Two drivers and a service, one and a half seconds long; made by the first test that wants it."""
    file = tmp_path / "skin.mcap"
    if not made:
        two_drivers_and_a_service(file)
        made["skin"] = file.read_bytes()
    file.write_bytes(made["skin"])
    return file


@pytest.fixture
def cable() -> Iterator[Cable]:
    cable = Cable()
    yield cable
    cable.close()
