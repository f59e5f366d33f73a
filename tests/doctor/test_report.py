"""The report to attach to an issue: readable, and without secrets."""

from __future__ import annotations

import os
import pwd
import re
import socket
from pathlib import Path

import click
import pytest

from skinware import Namespace
from skinware.cli._command import exit_status
from skinware_drivers.cli.doctor import as_text, command
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.report import Secrets, as_markdown, scrubbed
from tests.cli.fake_skin import FakeSkin, publishing
from tests.doctor.rig import looked

PLANTED = {
    "SKIN_TOKEN": "hunter2",
    "OPENAI_API_KEY": "sk-proj-abcdefghijklmnop",
    "DEPLOY_URL": "https://deploy.example/here",
    "USER": "marguerite",
    "HOME": "/home/marguerite",
    "LOGNAME": "marguerite",
    "SUDO_USER": "annegret",
}
TEXTS = [
    ("user marguerite runs it", "user <user> runs it"),
    ("MARGUERITE's skin, marguerite-tool", "<user>'s skin, <user>-tool"),
    ("sudo by annegret", "sudo by <user>"),
    ("/home/marguerite/skins/walk.mcap is damaged", "<home>/<folder>/walk.mcap is damaged"),
    ("hunter2", "<SKIN_TOKEN>"),
    ("key sk-proj-abcdefghijklmnop", "key <OPENAI_API_KEY>"),
    ("sent to https://deploy.example/here", "sent to <DEPLOY_URL>"),
    ("password = opensesame", "<token>"),
    ("token:abc", "<token>"),
    ("ghp_0123456789abcdefABCDEF012345", "<token>"),
    ("eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiIxIn0.abc_DEF-1", "<token>"),
    ("4f2c1d0e9b8a7766554433221100ffeeddccbbaa", "<token>"),
    ("from 192.168.17.4 and fe80::1ff:fe23:4567:890a", "from <address> and <address>"),
    ("mac 02:42:ac:11:00:02", "mac <address>"),
    ("mail a.b@example.org", "mail <address>"),
    ("socket://marguerite:pw1@robot", "socket://<address>@robot"),
    ("/srv/projects/skin/walk.mcap:3", "/<folder>/walk.mcap:3"),
]
KEPT = [
    "Linux 6.1.0-18-amd64 x86_64, Python 3.11.7, numpy 2.4.6, skinware 0.1.0",
    "/dev/shm/skinware.default/pose.ring: wrong magic",
    "/dev/ttyUSB0 and /dev/serial/by-id/usb-FTDI_FT232R-if00-port0",
    "18DA00F1 [8] 01 02 03 04 05 06 07 08",
    "sudo ip link set can0 type can bitrate 1000000",
    "docs/troubleshooting.md#a-bus-has-a-problem",
    "at 12:30:05, board 7, triangle 3, taxel 5; frames 15,729 (+12)",
    "member of group dialout; root may",
]


@pytest.mark.parametrize(("text", "expected"), TEXTS)
def test_what_is_nobodys_business_is_taken_out(text: str, expected: str) -> None:
    assert scrubbed(text, Secrets.of_this_machine(PLANTED)) == expected


@pytest.mark.parametrize("text", KEPT)
def test_what_is_needed_stays(text: str) -> None:
    assert scrubbed(text, Secrets.of_this_machine({})) == text


def test_this_machine_and_its_people_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "zebra7.lab.example")
    person = pwd.struct_passwd(("gudrun", "x", 1003, 1003, "Gudrun Meier,,,", "/data/gudrun", "/bin/sh"))
    monkeypatch.setattr(pwd, "getpwall", lambda: [person])
    secrets = Secrets.of_this_machine({})
    text = "zebra7 and zebra7.lab.example: Gudrun Meier (gudrun) in /data/gudrun/x"
    assert scrubbed(text, secrets) == "<machine> and <machine>: <user> (<user>) in <home>/x"


def test_a_whole_report_has_none_of_what_was_planted(
    namespace: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In names of drivers, files, programs and messages; and in the environment."""
    for name, value in PLANTED.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(socket, "gethostname", lambda: "zebra7")
    skin = FakeSkin("marguerite-zebra7")
    skin.break_some()
    file = tmp_path / "report.md"
    with publishing(skin):
        (namespace.path / "hunter2.ring").write_bytes(b"x")
        assert exit_status(command, ["-T", "0.2", "--report", str(file)]) == 1
        (namespace.path / "hunter2.ring").unlink()
    assert f"written to {file}" in capsys.readouterr().out
    text = file.read_text()
    hidden = [*PLANTED.values(), "zebra7", os.environ["SKINWARE_NAMESPACE"], str(Path.home())]
    assert [one for one in hidden if one != "/" and re.search(rf"(?<!\w){re.escape(one)}(?!\w)", text)] == []
    assert "<user>-<machine>" in text
    assert "<SKIN_TOKEN>.ring" in text


def test_it_is_markdown_that_tells_all(namespace: Namespace) -> None:
    skin = FakeSkin("torso")
    skin.break_some()
    with publishing(skin):
        evidence = looked()
    found = examine(evidence)
    text = as_markdown(map(click.unstyle, as_text(evidence, found, width=None)), evidence.drivers, Secrets())
    for finding in found.findings:
        assert f"{finding.area}  {finding.what}" in text
        assert f"  evidence  {finding.evidence}" in text
    for looked_at in found.looked:
        assert f"{looked_at.what}: {looked_at.seen}" in text
    assert "bus can0: frames 5156 (+0), dropped 2 (+0), unknown 7 (+0)" in text
    assert text.count("```") % 2 == 0


def test_a_report_that_cannot_be_written_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["-T", "0", "--report", str(tmp_path / "no/such/report.md")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "No such file or directory" in error
