"""A machine on which only the devices and programs of a test exist."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from skinware import Namespace
from skinware_drivers.doctor import looking
from skinware_drivers.finding import interfaces, ports
from skinware_drivers.testing.driving import EmulatedSkin
from tests.finding.fakes import see_only


@pytest.fixture(autouse=True)
def alone(namespace: Namespace, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Other tests may have drivers and namespaces, and the machine may drop packets; the folder of namespaces."""
    root = tmp_path_factory.mktemp("shm")
    see_only(namespace, root, monkeypatch)
    monkeypatch.setattr(looking, "ROOT", root)
    monkeypatch.setattr(looking, "softnet_dropped", lambda: 0)
    monkeypatch.setattr(interfaces, "can_interfaces", list)
    monkeypatch.setattr(ports, "serial_ports", list)
    return root


@pytest.fixture
def skins(emulated_skin: Callable[..., EmulatedSkin]) -> Callable[..., EmulatedSkin]:
    """Makes drivers that run on emulated devices, under a name beside that of the function that makes one."""
    return emulated_skin
