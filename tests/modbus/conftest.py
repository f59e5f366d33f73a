"""What tests with real peers are run over."""

from __future__ import annotations

from typing import Any

import pytest

from skinware_drivers import native
from tests.modbus.peers import rtu_server, tcp_server


@pytest.fixture(params=["native", "python"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Who asks while all is well."""
    if request.param == "python":
        monkeypatch.setattr(native, "library", lambda: None)
    elif native.library() is None:
        pytest.skip(native.why_python())
    return str(request.param)


@pytest.fixture(params=["tcp", "rtu"])
def over(request: pytest.FixtureRequest, way: str) -> Any:
    return tcp_server if request.param == "tcp" else rtu_server
