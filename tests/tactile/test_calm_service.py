"""The service that calms a driver, and its command."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Namespace, PatchState, Status
from skinware.errors import ConfigurationError, NameInUse, RequestFailed, ServiceError, SkinwareError
from skinware.tactile.baseline import Baseline
from skinware.tactile.calm_service import CalmService
from skinware.tactile.chain import ChainSettings
from skinware.tactile.chain_state import default_path, read_state, save_state
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.commands import BIN, refused, run, running
from tests.tactile.reading import read_until


@pytest.fixture(autouse=True)
def own_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, calm_namespace: Namespace) -> None:
    """States are kept in a folder of this test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def into() -> str:
    """The name of the ``calm_namespace`` of this test."""
    return f"{Namespace().name}-calm"


@contextmanager
def calming(name: str = "fake", *, frames: int = 1, **how: Any) -> Iterator[CalmService]:
    """A service that runs in a thread, and has taken some frames."""
    service = CalmService(name, into=into(), **how)
    failure: list[SkinwareError] = []

    def work() -> None:
        try:
            service.run()
        except SkinwareError as error:
            failure.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        wait_until(lambda: service.frames >= frames or bool(failure))
        if not failure:
            yield service
    finally:
        service.stop()
        thread.join()
    if failure:
        raise failure[0]


def idle(skin: FakeSkin) -> FakeSkin:
    """Nobody touches it: all sensors show 200."""
    skin.values = np.full(skin.structure.n_sensors, 200.0)
    return skin


def test_a_calmed_driver_is_the_driver_with_zero_where_nothing_touches() -> None:
    with publishing(idle(FakeSkin())) as skin, calming() as service:
        skin.status[30] = Status.STALE
        with DriverReader("fake", namespace=into()) as reader:
            assert np.array_equal(reader.structure.sensor_uid, skin.structure.sensor_uid)
            assert reader.structure.dtype == np.float32
            assert reader.structure.type("pressure").unit == "counts"
            assert reader.structure.type("pressure").maximum == 255
            assert reader.structure.patch_names == skin.structure.patch_names
            frame = reader.read()
            assert (frame.status_of("pressure")[:20] == Status.NEVER_SEEN).all()
            assert frame.physical("temperature")[0] == 100
            assert reader.call("tare")["pressure"] >= 639
            read_until(reader, lambda frame: bool(frame.status[30] & Status.STALE) and not frame.status[:10].any())
            assert skin.values is not None
            skin.values[12] = 150
            frame = read_until(reader, lambda frame: frame.values[12] > 0)
            assert np.flatnonzero(frame.physical("pressure")).tolist() == [10]
            assert frame.values[12] == 50
            assert service.status()["why"]["pressure"]["held"] == 1
            assert frame.fresh("pressure", at_ns=frame.acquired_ns)[10]
            assert [list(names) for names in reader.bus_counters(frame)] == [["frames", "dropped", "errors", "unknown"]]
            with DriverReader("fake") as source:
                newest = source.read()
            assert abs(frame.acquired_ns - newest.acquired_ns) < 10e9
            skin.values[12] = 200
            read_until(reader, lambda frame: not frame.values[12])


def test_sensors_that_a_touch_lowers_are_doubted_aloud_once(caplog: pytest.LogCaptureFixture) -> None:
    structure = fake_structure(1, 2)
    pressed = np.arange(structure.n_sensors)[structure.index("pressure")][3]
    with DriverWriter("fake", structure, rate_hz=20) as writer, calming(frames=0) as service:
        for number in range(300):  # 15 s at 20 Hz by its stamps; the second half of each 4 s is a touch
            is_touched = number >= 140 and number % 80 >= 40
            columns = writer.begin()
            columns["values"][:] = 200
            columns["values"][pressed] = 240 if is_touched else 200
            columns["module_time_ns"][:] = 1_000_000_000 + 50_000_000 * number
            columns["status"][:] = 0
            writer.commit(1_000_000_000 + 50_000_000 * number)
            wait_until(lambda: service.frames == writer.sequence)
        assert service.status()["why"]["pressure"]["doubted"] == 1
    assert caplog.text.count("if a touch lowers them") == 1


def test_operations_and_what_they_refuse() -> None:
    with publishing(idle(FakeSkin())) as skin, calming(), DriverReader("fake", namespace=into()) as reader:
        assert sorted(reader.operations()) == ["hold", "settings", "tare"]
        assert reader.call("tare", patch="board 8") == {"pressure": 160}
        assert reader.call("hold", on=True) == {"pressure": True}
        assert reader.call("hold", on=False, type="pressure") == {"pressure": False}
        assert reader.call("settings")["pressure"]["tau_s"] == 30
        assert reader.call("settings", tau_s=12.5, minimum_on=4)["pressure"]["tau_s"] == 12.5
        assert reader.call("settings")["pressure"]["minimum_on"] == 4
        before = reader.read()
        assert reader.request().sequence > before.sequence
        for operation, arguments, words in (
            ("tare", {"patch": "board 1"}, "no patch 'board 1'; there are: board 7"),
            ("tare", {"type": "temperature"}, "no baseline of 'temperature'; there are: pressure"),
            ("hold", {"on": 1}, "give true or false"),
            ("settings", {"tau_s": 0}, "tau_s = 0"),
            ("settings", {"tau": 1}, "no setting 'tau'; there are: tau_s"),
            ("settings", {"tau_s": "x"}, "give a number"),
        ):
            with pytest.raises(RequestFailed, match=words):
                reader.call(operation, **arguments)
        with pytest.raises(RequestFailed, match="unexpected keyword"):
            reader.call("tare", board=7)
        assert skin.writer.sequence


@pytest.mark.thorough
def test_it_survives_the_driver_and_tells_that_it_is_gone(namespace: Namespace) -> None:
    with calming_process() as calm:
        with fake_process("fake", "--rate", "50") as process:
            calm.wait_for("ready")
            reader = DriverReader("fake", namespace=into())
            assert reader.call("tare")["pressure"] > 0
            read_until(reader, lambda frame: not frame.status[0] & Status.NEVER_SEEN)
            kill(process)
            frame = read_until(reader, lambda frame: bool((frame.status & Status.STALE).all()))
            assert (frame.patch_state == PatchState.STALE).all()
            assert calm.wait_for("status", lambda status: not status["driver_alive"])
        with fake_process("fake", "--rate", "50"):
            frame = read_until(reader, lambda frame: not (frame.status & Status.STALE).any())
            assert not (frame.status & Status.NEVER_SEEN).any(), "what was learned was kept"
            assert calm.wait_for("status", lambda status: status["driver_alive"])
        with fake_process("fake", "--rate", "50", "--modules", "8"):
            ready = calm.wait_for("ready")
            assert ready["modules"] == 32
            reader.reattach()
            frame = read_until(reader, lambda frame: frame.structure.n_modules == 32)
            assert not (frame.status & Status.NEVER_SEEN).any(), "of each sensor that is still there"
        reader.close()
        assert calm.stop(signal.SIGTERM)["event"] == "stopped"
        assert calm.process.returncode == 0
    assert not Namespace(into()).services()


@contextmanager
def calming_process(*options: str) -> Iterator[Any]:
    with running("skin-calm", "fake", "--into", into(), *options) as calm:
        yield calm


@pytest.mark.thorough
def test_it_waits_for_a_driver_that_is_not_there_and_says_so() -> None:
    with calming_process() as calm:
        wait_until(lambda: "waiting for driver 'fake'" in calm.errors)
        with publishing(idle(FakeSkin())):
            ready = calm.wait_for("ready")
            assert (ready["name"], ready["driver"], ready["into"]) == ("fake", "calm", into())
            assert ready["types"] == {"pressure": 640, "temperature": 128}
            assert ready["stages"] == [{"type": "pressure", "stage": "baseline"}]
            status = calm.wait_for("status", lambda status: status["frames"] > 0)
            assert status["ready"] == {"pressure": 0}
        assert calm.stop()["event"] == "stopped"
        assert calm.process.returncode == 0


@pytest.mark.thorough
def test_it_needs_no_name_where_one_driver_runs() -> None:
    with publishing(idle(FakeSkin())):
        with running("skin-calm", "--into", into()) as calm:
            assert calm.wait_for("ready")["name"] == "fake"
        with publishing(FakeSkin("torso")):
            done = refused("skin-calm", "--into", into())
    assert (done.returncode, "choose one with skin-calm NAME: fake, torso" in done.stderr) == (2, True)
    done = refused("skin-calm", "--into", into())
    assert (done.returncode, "no driver runs in namespace" in done.stderr) == (1, True)


def test_what_was_learned_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "state" / "skin.npz"
    with publishing(idle(FakeSkin())) as skin:
        with calming(state_path=path), DriverReader("fake", namespace=into()) as reader:
            reader.call("tare")
            assert skin.values is not None
            skin.values[12] = 150
            read_until(reader, lambda frame: frame.values[12] > 0)
        with calming(state_path=path) as service, DriverReader("fake", namespace=into()) as reader:
            assert service.restored == 640
            assert read_until(reader, lambda frame: frame.values[12] > 0).values[12] == 50, "the load is still there"
    with publishing(idle(FakeSkin(structure=fake_structure(4, 16).replace(types=counts_of_another_scale())))):
        with calming(state_path=path) as service:
            assert service.restored == 0, "what it saw is another thing now"


def counts_of_another_scale() -> list[Any]:
    pressure, temperature = fake_structure().types
    return [pressure.measured(scale=-2.0, offset=255.0), temperature]


@pytest.mark.parametrize("damage", ["empty", "garbage", "cut", "old", "future", "keys", "shapes", "folder"])
def test_a_state_that_is_no_good_is_left_alone(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "skin.npz"
    structure = fake_structure()
    chain = ChainSettings.calm().chain(structure)
    state = chain.state()
    if damage == "keys":
        del state.arrays["pressure/noise2"]
    if damage == "shapes":
        state.arrays["pressure/level"] = np.zeros((640, 2), np.float32)
    save_state(path, state)
    whole = path.read_bytes()
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "garbage":
        path.write_bytes(b"PK" + bytes(range(256)))
    elif damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage in ("old", "future"):
        with np.load(path) as file:
            arrays = dict(file)
        arrays["time_s"] = np.array(time.time() + (1000 if damage == "future" else -1000))
        np.savez(path, allow_pickle=False, **arrays)
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    with publishing(idle(FakeSkin())), calming(state_path=path) as service:
        assert service.restored == 0
    assert "the learned state does not fit" in caplog.text or damage == "folder"


def test_a_state_says_nothing_of_sensors_that_it_does_not_have() -> None:
    one, other = (Baseline(np.zeros(n, int), np.zeros(n, int)) for n in (4, 3))
    one.update(1, [10.0, 20, 30, 40])
    one.tare()
    assert other.restore(one.state(), np.array([3, -1, 0])) == 2
    assert other.ready.tolist() == [True, False, True]
    with pytest.raises(ConfigurationError, match="no state of a baseline"):
        other.restore({}, np.array([0, 1, 2]))
    assert read_state(Path("/nowhere/at/all.npz")) == (None, "")


def test_states_are_kept_where_the_account_may_write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert default_path("calm", "torso") == tmp_path / "skinware/calm/calm.torso.npz"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/skin:/other")
    assert default_path("calm", "torso") == Path("/var/lib/skin/calm.torso.npz")


def test_a_state_that_cannot_be_kept_ends_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    with publishing(idle(FakeSkin())), calming(state_path=tmp_path / "file" / "skin.npz"):
        with DriverReader("fake", namespace=into()) as reader:
            reader.call("tare")
    assert "cannot be kept" in caplog.text


def test_two_of_a_name_and_one_into_itself(namespace: Namespace) -> None:
    with pytest.raises(ConfigurationError, match="give another with --into"):
        CalmService("fake", into=namespace)
    with publishing(idle(FakeSkin())), calming():
        with pytest.raises(NameInUse), calming():
            pass


def test_a_driver_that_is_paused_or_has_no_period_is_no_trouble() -> None:
    with publishing(idle(FakeSkin())) as skin, calming() as service:
        skin.is_hung = True
        with DriverReader("fake", namespace=into()) as reader:
            taken = service.frames
            skin.writer.pause()
            time.sleep(0.2)
            skin.writer.resume()
            assert not reader.structure_changed
            skin.is_hung = False
            wait_until(lambda: service.frames > taken + 3)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a/b"], "driver name"),
        (["fake", "--into", "a b"], "namespace name"),
        (["fake", "--config", "/no/such.toml"], "/no/such.toml: No such file"),
        (["fake", "--into", "default", "--namespace", "default"], "give another with --into"),
    ],
)
def test_mistakes_get_one_clear_line(arguments: list[str], words: str) -> None:
    done = run("skin-calm", *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.thorough
def test_a_stage_that_cannot_be_made_for_the_driver_ends_it(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text('format = "skinware-chain"\nversion = 1\n[[stage]]\nstage = "baseline"\ntypes = ["temperature"]\n')
    with publishing(idle(FakeSkin())):
        done = run("skin-calm", "fake", "--into", into(), "--config", str(path))
    assert done.returncode == 2
    assert f"{path}:3: baseline: a temperature has no rest" in done.stderr


@contextmanager
def running_text(*arguments: str) -> Iterator[Iterator[str]]:
    """The lines of ``skin-calm``, which is interrupted at the end."""
    process = subprocess.Popen([BIN / "skin-calm", *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield (line.rstrip("\n") for line in process.stdout)
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        process.stdout.close()


@pytest.mark.thorough
def test_text_for_people(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text(
        'format = "skinware-chain"\nversion = 1\n[[stage]]\nstage = "baseline"\n[[stage]]\nstage = "filter"\n'
    )
    with publishing(FakeSkin()):
        with running_text("fake", "--into", into(), "--config", str(path)) as lines:
            assert next(lines) == "fake: pressure [counts] through baseline, filter; temperature [degC] through filter"
            assert into() in next(lines)


@pytest.mark.thorough
def test_the_calmed_driver_is_a_driver_for_every_command() -> None:
    with publishing(idle(FakeSkin())), calming():
        shown = json.loads(run("skin-info", "--namespace", into(), "--json").stdout)
        assert shown["drivers"][0]["driver_type"] == "calm"
        dumped = run("skin-dump", "fake", "-n", "1", "--json", "--namespace", into())
        assert len(json.loads(dumped.stdout)["values"]) == 768


def test_no_driver_is_found_once_it_was_closed() -> None:
    with publishing(idle(FakeSkin())), calming():
        pass
    with pytest.raises(ServiceError):
        DriverReader("fake", namespace=into())
