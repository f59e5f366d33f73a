"""What tests with real peers are run over."""

from __future__ import annotations

from typing import Any

import pytest

from skinware_drivers.modbus.bus import ModbusBus
from tests.modbus.peers import rtu_server, tcp_server


@pytest.fixture(params=["native", "python"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Which master asks while all is well."""
    if request.param == "python":
        monkeypatch.setattr(ModbusBus, "reads_natively", False)
        monkeypatch.setattr(ModbusBus, "hand_over", lambda *_: False)
    return str(request.param)


@pytest.fixture(params=["tcp", "rtu"])
def over(request: pytest.FixtureRequest, way: str) -> Any:
    return tcp_server if request.param == "tcp" else rtu_server
