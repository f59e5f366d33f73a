"""``skin-config`` on a real CAN socket."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from skinware.cli._command import exit_status
from skinware_drivers.can import roboskin_setup
from skinware_drivers.cli.config import command
from tests.commands import running

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]


def test_a_board_gets_another_address(
    vcan: Callable[[], str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roboskin_setup, "_REPLY_S", 5.0)  # a starved emulator answers, too
    name = vcan()

    def configured(*arguments: str) -> Any:
        assert exit_status(command, [name, *arguments, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    with running("skin-emulate", "--bus", name, "--boards", "7,8") as emulator:
        emulator.wait_for("ready")
        moved = configured("set_address", "address=9", "patch=board 7", "--yes")
        assert moved["driver"] is None
        assert moved["results"][name]["is"] == 9
        assert configured("versions")["results"][name].keys() == {"8", "9"}
