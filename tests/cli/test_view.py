"""skin-view as people and scripts use it; what it serves is tested in tests/views."""

from __future__ import annotations

import datetime
import shutil
import signal
import socket
import ssl
import time
from contextlib import closing
from pathlib import Path

import pytest
import segno
import trustme
from websockets.exceptions import InvalidStatus

from skinware import Namespace
from skinware.cli import view as view_module
from skinware.cli._command import exit_status
from skinware.cli.view import addresses, qr_text
from skinware.cli.view import command as view
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import refused, run, running
from tests.views.client import page_of


@pytest.mark.parametrize(
    ("number", "is_held"),
    [(signal.SIGINT, False), (signal.SIGINT, True), pytest.param(signal.SIGTERM, False, marks=pytest.mark.thorough)],
)
def test_it_serves_until_it_is_told_to_end(namespace: Namespace, number: int, is_held: bool) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))), publishing(FakeSkin("arm", fake_structure(1, 2))):
        with running("skin-view", "torso", "--port", "0", "--no-browser") as server:
            ready = server.wait_for("ready")
            assert (ready["namespace"], ready["names"]) == (namespace.name, ["torso"])
            with page_of(ready["url"]) as viewer:
                viewer.pull_until(lambda _: viewer.skin["drivers"])
                assert [driver["name"] for driver in viewer.skin["drivers"]] == ["torso"]
                while is_held and server.process.poll() is None:
                    server.process.send_signal(number)
                    time.sleep(0.001)  # without a pause they are few
                assert server.stop(number) == {}
                assert server.errors == ""
                ends = [0, -number] if is_held else [0]  # the last of many may find the command at its end
                assert server.process.returncode in ends


def test_its_address_for_people(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(view_module, "_serve", ready_at_once)
    monkeypatch.setenv("DISPLAY", ":0")
    assert exit_status(view, ["torso", "arm"]) == 0
    assert capsys.readouterr().out == "http://127.0.0.1:5/ shows torso, arm (Ctrl-C ends)\n"
    assert exit_status(view, ["--no-browser", "--host", "::1"]) == 0
    assert capsys.readouterr().out.startswith("http://[::1]:5/ shows all drivers of namespace ")
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert exit_status(view, []) == 0
    assert opened == ["http://127.0.0.1:5/"]


def test_all_addresses_for_other_machines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(view_module, "_serve", ready_at_once)
    monkeypatch.setattr(view_module, "addresses", lambda _: ["10.0.0.7", "fd00::7", "robot"])
    assert exit_status(view, ["--no-browser", "--host", "0.0.0.0", "--token", "abc"]) == 0
    first, *more = capsys.readouterr().out.splitlines()
    assert first.startswith("http://10.0.0.7:5/?token=abc shows all drivers of namespace ")
    assert more[:2] == ["http://[fd00::7]:5/?token=abc", "http://robot:5/?token=abc"]
    assert [row for row in more[2:] if row] == qr_text("http://10.0.0.7:5/?token=abc").splitlines()
    monkeypatch.setattr(view_module, "find_spec", lambda name: None if name == "segno" else True)
    assert exit_status(view, ["--no-browser", "--host", "0.0.0.0"]) == 0
    assert capsys.readouterr().out.endswith("for a QR code of it: pip install segno\n")


def test_the_qr_code_is_the_address() -> None:
    url = "http://10.0.0.7:8736/?token=abc"
    rows = qr_text(url).splitlines()
    drawn = [[sign in half for sign in row] for row in rows for half in ("█▀", "█▄")]  # light modules
    quiet = 4
    code = [[not light for light in row[quiet:-quiet]] for row in drawn[quiet:]]
    matrix = [[bool(module) for module in row] for row in segno.make(url, error="l").matrix]
    assert code[: len(matrix)] == matrix


def test_addresses_are_those_of_this_machine() -> None:
    assert addresses("127.0.0.1") == ["127.0.0.1"]
    *found, name = addresses("0.0.0.0")
    assert name == socket.gethostname()
    for address in found:
        with socket.socket() as listener:
            listener.bind((address, 0))


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    """Certificates of this machine: a good one, one that has expired, and one with the key of another."""
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    expired = datetime.datetime(2020, 1, 2, tzinfo=datetime.UTC)
    for folder, end in {"good": None, "expired": expired, "mixed": None}.items():
        (tmp_path / folder).mkdir()
        made = authority.issue_cert("127.0.0.1", not_after=end)
        made.cert_chain_pems[0].write_to_path(tmp_path / folder / "cert.pem")
        made.private_key_pem.write_to_path(tmp_path / folder / "key.pem")
    shutil.copy(tmp_path / "good" / "key.pem", tmp_path / "mixed")
    (tmp_path / "empty").mkdir()
    return tmp_path


def test_https_with_a_certificate(certificates: Path) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 2))):
        arguments = ("--port", "0", "--no-browser", "--tls", str(certificates / "good"))
        with running("skin-view", *arguments) as server:
            url = server.wait_for("ready")["url"]
            assert url.startswith("https://127.0.0.1:")
            trusting = ssl.create_default_context(cafile=certificates / "ca.pem")
            with page_of(url, ssl=trusting) as viewer:
                viewer.pull_until(lambda _: viewer.skin["drivers"])
            with pytest.raises(ssl.SSLCertVerificationError), page_of(url, ssl=ssl.create_default_context()):
                pass


@pytest.mark.parametrize(
    ("folder", "why"),
    [
        ("empty", "cert.pem is missing; the folder needs cert.pem and key.pem"),
        ("mixed", "they do not belong together"),
        ("expired", "certificate has expired"),
    ],
)
def test_certificates_that_nobody_would_trust(
    certificates: Path, folder: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(view, ["--no-browser", "--tls", str(certificates / folder)]) == 2
    assert why in capsys.readouterr().err


async def ready_at_once(*arguments: object) -> None:
    arguments[-1](5)  # type: ignore[operator]


def test_recordings_are_in_the_address_or_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with publishing(FakeSkin("torso", fake_structure(1, 1))):
        Recorder(Files(Path("a b.mcap"))).run(0.3)
    monkeypatch.setattr(view_module, "_serve", ready_at_once)
    assert exit_status(view, ["--no-browser", "a b.mcap", "./a b.mcap", "torso"]) == 0
    url, _, what = capsys.readouterr().out.partition(" shows ")
    assert url.endswith("/?recording=a+b.mcap&recording=a+b.mcap")
    assert what == "a b.mcap, a b.mcap, torso (Ctrl-C ends)\n"
    Path("foreign.mcap").write_text("hello")
    for name, why in (
        ("foreign.mcap", "not a recording (not an MCAP file); skin-convert --guess begins with data of others"),
        ("gone.mcap", "No such file or directory"),
    ):
        assert exit_status(view, ["--no-browser", name]) == 2
        assert capsys.readouterr().err == f"skin-view: {name}: {why}\n"


@pytest.mark.thorough
def test_other_machines_need_a_token() -> None:
    with running("skin-view", "--port", "0", "--no-browser", "--host", "0.0.0.0") as server:
        url = server.wait_for("ready")["url"]
        where, _, token = url.partition("?token=")
        assert len(token) > 20
        port = where.rstrip("/").rpartition(":")[2]
        with pytest.raises(InvalidStatus, match="401"), page_of(f"http://127.0.0.1:{port}/"):
            pass
        with page_of(f"http://127.0.0.1:{port}/?token={token}") as page:
            page.pull()


@pytest.mark.thorough
def test_a_token_of_ones_own() -> None:
    with running("skin-view", "--port", "0", "--no-browser", "--token", "sesame") as server:
        assert server.wait_for("ready")["url"].endswith("/?token=sesame")


@pytest.mark.thorough
def test_a_port_that_is_in_use() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = str(other.getsockname()[1])
        result = run("skin-view", "--port", port, "--no-browser")
        assert (result.returncode, result.stdout) == (1, "")
        why = "in use: give another --port, or 0 for any that is free"
        assert result.stderr == f"skin-view: 127.0.0.1, port {port}: {why}\n"


@pytest.mark.thorough
def test_another_port_where_the_usual_one_is_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    with running("skin-view", "--no-browser") as one, running("skin-view", "--no-browser") as other:
        assert one.wait_for("ready")["url"] != other.wait_for("ready")["url"]


@pytest.mark.parametrize(
    ("arguments", "status", "why"),
    [
        (("--port", "99999"), 2, "99999"),
        (("--port", "0", "--host", "no.such.host.invalid"), 1, "no.such.host.invalid"),
        (("--port", "0", "--host", "192.0.2.1"), 1, "192.0.2.1"),
        (("--port", "0", "no driver"), 2, "driver name 'no driver'"),
        (("--port", "0", "--namespace", "a/b"), 2, "namespace name 'a/b'"),
        (("--port", "0", "--calm", "a/b"), 2, "namespace name 'a/b'"),
        (("--port", "0", "--token", "with space"), 2, "--token"),
        (("--port", "0", "--links", "none.urdf"), 2, "none.urdf: No such file"),
    ],
)
def test_bad_input_is_said_in_a_line(arguments: tuple[str, ...], status: int, why: str) -> None:
    result = refused("skin-view", "--no-browser", *arguments)
    assert (result.returncode, result.stdout) == (status, "")
    assert why in result.stderr
    assert result.stderr.strip().count("\n") <= (3 if status == 2 else 0)


def test_without_its_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(view_module, "find_spec", lambda _: None)
    assert exit_status(view, ["--no-browser"]) == 1
    assert "pip install 'skinware[view]'" in capsys.readouterr().err
