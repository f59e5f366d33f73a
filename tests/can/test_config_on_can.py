"""``skin-config`` on a real CAN socket, beside and without a driver."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from skinware.cli._command import exit_status
from skinware_drivers.cli.config import command
from tests.commands import running

pytestmark = pytest.mark.can


def test_a_board_gets_an_address_and_a_driver_is_not_gone_behind(
    vcan: Callable[[], str], capsys: pytest.CaptureFixture[str]
) -> None:
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
        with running("skin-driver", "--bus", name, "--name", "torso") as driver:
            driver.wait_for("ready")
            through = configured("versions")
            assert through["driver"]["name"] == "torso"
            assert through["results"][name].keys() == {"8", "9"}
            assert exit_status(command, [name, "set_address", "address=7", "patch=board 9", "--yes"]) == 2
            assert "needs the bus without a driver: end driver 'torso'" in capsys.readouterr().err
