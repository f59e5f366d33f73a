"""What a person reads of ``skin-info``: on a narrow terminal, and of skins that are not well."""

from __future__ import annotations

import re

import click
import numpy as np
import pytest

from skinware import DriverReader, Namespace, Status
from skinware.cli import info
from skinware.cli._command import exit_status
from skinware.cli._report import report
from skinware.cli.info import as_text, command
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing


def shown(capsys: pytest.CaptureFixture[str]) -> str:
    assert exit_status(command, []) == 0
    return capsys.readouterr().out


def test_no_line_is_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    skin = FakeSkin("a")
    skin.break_some()
    skin.interval_counts[:, 20] = skin.age_counts[:, 16] = 7
    with publishing(skin), DriverReader("a") as reader:
        for _ in range(3):
            reader.read(timeout_s=30)
        found = report(Namespace())
        assert max(map(len, as_text(found))) > 80
        monkeypatch.setattr(info, "terminal_width", lambda: 80)
        lines = [click.unstyle(line) for line in as_text(found)]
    assert max(map(len, lines)) <= 80
    words = " ".join(lines)
    for title in ("interval 99 %", "delay 99 %", "orphans", "data age", "not taken"):
        assert title in words


def test_modules_that_have_sent_nothing_but_0_are_fresh_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(2, 1)) as skin:
        skin.publish()
        assert "untouched" not in shown(capsys)
        skin.untouched = np.array([0, 1], np.uint8)
        skin.publish()
        lines = shown(capsys)
    assert re.search(r"sensors: .*; 12 untouched so far \(only 0\)\n", lines)
    assert re.search(r"board 8 +can0 +live +12 of 12", lines)


def test_who_has_no_fresh_sensor_is_not_called_live(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(2, 1)) as skin:
        skin.status[:] = Status.NOT_CONNECTED
        skin.status[0] = 0
        skin.publish()
        lines = shown(capsys)
        assert re.search(r"board 7 +can0 +live +1 of 12", lines)
        assert re.search(r"board 8 +can0 +not fresh +0 of 12", lines)
        assert "but no sensor is fresh" not in lines
        skin.status[:] = Status.NOT_CONNECTED
        skin.publish()
        assert "driver a: live, but no sensor is fresh, " in shown(capsys)
