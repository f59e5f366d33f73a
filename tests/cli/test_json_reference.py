"""docs/reference/json.md says what is printed: no key is missing there, and none stands there that is never printed."""

from __future__ import annotations

import io
import json
import re
import runpy
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from skinware import DriverReader, Namespace, PatchState, Sample, ServiceReader, ServiceWriter
from skinware.bridge_state import BridgeState, BridgeStateWriter
from skinware.cli._command import exit_status
from skinware.cli.calibrate import command as calibrate
from skinware.cli.convert import command as convert
from skinware.cli.info import command as info
from skinware.cli.press import command as press
from skinware.cli.recover import command as recover
from skinware.cli.regions import command as regions
from skinware.cli.top import command as top
from skinware.geometry import geometry_to_toml
from skinware.realtime import now_ns
from skinware.tactile.calibration.state import PressSession
from skinware_drivers.cli.config import command as config
from skinware_drivers.cli.doctor import command as doctor
from skinware_drivers.cli.dump import command as dump
from skinware_drivers.cli.emulate import report_to
from skinware_drivers.cli.find import command as find
from skinware_drivers.cli.import_ import command as import_
from skinware_drivers.cli.replay import command as replay
from skinware_drivers.finding import interfaces, ports
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort, UsbIdentity, User
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.emulation import Emulation
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.cli.fake_skin import FakeSkin, publishing
from tests.cli.test_calibrate import calm_skin, finger_presses, force_session, gathered, stroked_state, strokes
from tests.cli.test_contacts import touched_skin
from tests.cli.test_regions import BLOCK, idle, painting, placed_structure, pressed
from tests.cli.test_sensor_health import looked_after
from tests.commands import run, running
from tests.finding.fakes import see_only
from tests.icub.conftest import WRAPPER, device
from tests.icub.test_positions import TRIANGLE, positions
from tests.recording.test_wire_export import ON_VCAN1, keep, write_recording
from tests.ros2.alone import own_domain
from tests.streams.peers import free_port
from tests.tactile.calibrating import Tool, presses, with_tool
from tests.virtual.test_emulate import HostBus
from tests.yarp.peers import LOCAL, robot, until_gone

PAGE = Path(__file__).parents[2] / "docs/reference/json.md"
VIRTUAL = "virtual?boards=7"
PLAIN: dict[str, Callable[[Any], bool]] = {
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: isinstance(value, int) and not isinstance(value, bool),
    "number": lambda value: isinstance(value, int | float) and not isinstance(value, bool),
    "boolean": lambda value: isinstance(value, bool),
    "object": lambda value: isinstance(value, dict),
    "null": lambda value: value is None,
    "any": lambda _value: True,
}
Rows = dict[str, str]


def page_with_tables() -> str:
    """The page as readers see it, with the tables that its directives make."""
    made = runpy.run_path(str(PAGE.parents[1] / "json_fields.py"))["json_fields"]
    return re.sub(
        r"^```\{json-fields\} (.+)\n```$", lambda at: "\n".join(made(*at[1].split())), PAGE.read_text(), flags=re.M
    )


def sections() -> dict[str, Rows]:
    """Type of every key, under the heading where it stands."""
    found: dict[str, Rows] = {}
    rows: Rows = {}
    for line in page_with_tables().splitlines():
        if line.startswith("#"):
            rows = found.setdefault(line.strip("# "), {})
        elif line.startswith("| `"):
            keys, kind, _meaning = (cell.strip() for cell in line.strip("|").split("|"))
            for key in re.findall(r"`([^`]+)`", keys):
                assert key not in rows, f"{key} stands there twice"
                rows[key] = kind.partition(",")[0]  # a unit follows
    return {heading: rows for heading, rows in found.items() if rows}


SECTIONS = sections()
PARTS = {heading.lower(): rows for heading, rows in SECTIONS.items() if "`" not in heading}


def expanded(rows: Rows) -> dict[str, list[str]]:
    """Full path and plain types of every key; keys of the parts that a row links to come below it."""
    found: dict[str, list[str]] = {}
    for key, told in rows.items():
        types = []
        for one in told.split(" or "):
            part = re.fullmatch(r"\[(.+)\]\(#(.+)\)", one)
            types.append("object" if part else one)
            if part:
                assert part[2] == part[1].replace(" ", "-")
                found |= {f"{key}.{below}": types for below, types in expanded(PARTS[part[1]]).items()}
        found[key] = types
    return found


def values(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value with its path; objects and lists as well as what is in them."""
    if path:
        yield path, data
    if isinstance(data, dict):
        for key, value in data.items():
            yield from values(value, f"{path}.{key}" if path else key)
    elif isinstance(data, list):
        for value in data:
            yield from values(value, f"{path}[]")


def _pattern(key: str, kinds: list[str]) -> re.Pattern[str]:
    """What paths a key of the page stands for; ``any`` is what it is, whatever is in it."""
    return re.compile(re.escape(key).replace("NAME", r"[^\[\]]+") + r"([.\[].*)?" * (kinds == ["any"]))


def check(heading: str, *printed: Any, open_ended: bool = False) -> None:
    """Compare what was printed with the page, both ways.

    Args:
        heading: where it stands.
        printed: enough to show every key.
        open_ended: there may be integers under other keys (the page says so).
    """
    rows = expanded(SECTIONS[heading])
    patterns = {key: _pattern(key, kinds) for key, kinds in rows.items()}
    leading = {key[: at.start()] for key in rows for at in re.finditer(r"\.|\[\]", key)}  # only lead to others
    inner = [_pattern(key, []) for key in leading]
    seen, wrong = set(), []
    for path, value in (pair for one in printed for pair in values(one)):
        keys = [key for key, pattern in patterns.items() if pattern.fullmatch(path)]
        seen.update(keys)
        if keys and not any(PLAIN[kind](value) for key in keys for kind in rows[key]):
            wrong.append(f"{path} is {value!r}, not {rows[keys[0]]}")
        elif not (
            keys
            or (isinstance(value, dict | list) and any(pattern.fullmatch(path) for pattern in inner))
            or (open_ended and PLAIN["integer"](value))
        ):
            wrong.append(f"{path} is not on the page")
    assert wrong == []
    assert sorted(rows.keys() - seen) == [], "on the page, and not printed"


Print = Callable[..., list[Any]]


@pytest.fixture
def printing(capsys: pytest.CaptureFixture[str]) -> Print:

    def run(command: click.Command, *arguments: str, status: int = 0) -> list[Any]:
        assert exit_status(command, [*arguments, "--json"]) == status, capsys.readouterr().err
        return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    return run


@pytest.mark.thorough
def test_a_driver_and_those_that_look_at_it(
    printing: Print, namespace: Namespace, calm_namespace: Namespace, tmp_path: Path
) -> None:
    with (
        running("skin-driver", "--bus", f"{VIRTUAL}&foreign_hz=200") as driver,
        ServiceWriter("pose", {"angle": ("f4", (2,)), "at": ([("x", "i4")], ())}, namespace=namespace) as service,
    ):
        check("`ready`", driver.wait_for("ready"))
        service.begin()
        service.commit(now_ns())
        with DriverReader("roboskin") as reader, ServiceReader[Sample]("pose") as other:
            read_until(reader, lambda frame: bool(frame.bus_samples["why"].any()))
            other.read()
            (namespace.path / "broken.ring").write_bytes(b"x")
            with BridgeStateWriter("icub", namespace) as bridge:
                bridge.publish(BridgeState("icub", False, now_ns(), None, None, 0, {}), now_ns())
                (told,) = printing(info)
            check("`skin-info`", told)
            (namespace.path / "broken.ring").unlink()
        (rows,) = printing(info, "roboskin", "--sensors")
        check("`skin-info NAME --sensors`", rows)
        with running(
            "skin-calm", "roboskin", "--into", calm_namespace.name, "--state", str(tmp_path / "state.npz")
        ) as calm:
            check("`ready` of a calmed driver", calm.wait_for("ready"))
            status = calm.wait_for("status", lambda status: bool(status["touched"]))
            check(
                "`skin-dump`",
                *printing(dump, "roboskin", "-n", "1", "--type", "pressure", "--counts"),
                *printing(dump, "roboskin", "-n", "1", "--namespace", calm_namespace.name),
            )
            check("`status`, `stopped` of a calmed driver", status, calm.stop())
        check("`skin-wipe`", *wiping())
        check(
            "`skin-config`", *printing(config, "roboskin"), *printing(config, "roboskin", "versions", "--timeout", "60")
        )
        status = driver.wait_for("status")
        check("`status`, `stopped`", status, driver.stop())


@pytest.mark.thorough
def test_patches_that_fall_silent() -> None:
    bus = "virtual?boards=7,8&restart=8&restart_after_s=1.5&boot_s=3"  # longer than a busy machine holds the driver up
    with running("skin-driver", "--bus", bus) as driver:
        silent = driver.wait_for("patches", lambda change: change["silent"] == ["board 8"])
        live = driver.wait_for("patches", lambda change: change["live"] == ["board 8"])
    check("`patches`", silent, live)
    assert "board 8 fell silent" in driver.errors


def test_a_driver_and_its_contacts(printing: Print) -> None:
    with touched_skin():
        check("`skin-top`", *printing(top, "--plain", "-T", "0.01"))


def test_bare_frames(printing: Print) -> None:
    check("`skin-dump --raw`", *printing(dump, "--raw", f"{VIRTUAL}&streaming=yes", "-n", "3"))


def test_what_is_found(printing: Print, namespace: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see_only(namespace, tmp_path, monkeypatch)
    can0 = CanInterface(
        "can0", "can", "peak_usb", False, "down", True, 10, 500_000, 2_000_000, 0.8, "BUS-OFF", 0, {"rx": 1}, {"off": 1}
    )
    usb = UsbIdentity("0403", "6001", "A50285BI", "FTDI", "FT232R", "1-1.2", "00")
    tty = SerialPort("/dev/ttyUSB0", "ftdi_sio", usb, ("/dev/skin/A5",), False, "dialout", False, (User(1, "init"),))
    monkeypatch.setattr(interfaces, "can_interfaces", lambda: [can0])
    monkeypatch.setattr(ports, "serial_ports", lambda: [tty])
    machine = printing(find, "--probe", "-T", "0.1")
    monkeypatch.setattr(interfaces, "can_interfaces", list)
    heard = printing(find, f"{VIRTUAL}&streaming=yes", "--probe", "-T", "1")
    no_interface = printing(find, "-T", "0.1")
    # what is heard on an interface of the kernel, and who has it, is told as it is for other buses
    owner = {"name": "a", "namespace": "b", "driver_type": "c", "pid": 1, "buses": ["can0"]}
    machine[0]["can"]["interfaces"][0] |= {**heard[0]["buses"][0], "used_by": owner}
    machine[0]["ports"][0]["used_by"] = owner
    heard[0]["buses"][0]["topics"] = [{"topic": "a", "type_name": "b", "publishers": 1, "drivers": ["dex3"]}]
    heard[0]["buses"][0]["used_by"] = owner
    for probe in (heard[0]["buses"][0]["probe"], machine[0]["ports"][0]["probe"]):
        probe |= {"asked": ["roboskin"], "answers": {"roboskin": "yes"}, "problems": {"xela": "no"}}
    check("`skin-find`", *machine, *heard, *no_interface)
    check("`skin-find --udev`", *printing(find, "--udev"))


@pytest.mark.thorough
def test_what_a_doctor_finds(printing: Print, tmp_path: Path) -> None:
    skin = FakeSkin("torso")
    skin.break_some()
    file = tmp_path / "skin.mcap"
    with publishing(skin):
        with running("skin-record", "torso", "-o", str(file)) as record:
            record.wait_for("status", lambda status: bool(status["messages"]))
            record.stop()
        live = printing(doctor, "-T", "0.2", status=1)
    check("`skin-doctor`", *live, *printing(doctor, str(file), status=1))


def test_robots_files(printing: Print, tmp_path: Path) -> None:
    (tmp_path / "skin.xml").write_text(device())
    (tmp_path / "wrapper.xml").write_text(WRAPPER)
    (tmp_path / "torso.txt").write_text(positions([TRIANGLE] * 32))
    text = printing(import_, "icub", str(tmp_path))
    check("`skin-import icub`", *text, *printing(import_, "icub", str(tmp_path), "-o", str(tmp_path / "out")))


def wiping() -> list[Any]:
    """What is told of a wipe that ends before everything was touched."""
    with running("skin-wipe", "roboskin", "-T", "1.5") as wipe:
        told = [wipe.wait_for(event) for event in ("ready", "wiping", "done")]
        wipe.stop()
    return told


def test_health(printing: Print, namespace: Namespace) -> None:
    with looked_after(namespace):
        check("`skin-info --health`", *printing(info, "--health"))


@pytest.mark.thorough
def test_regions(printing: Print, tmp_path: Path) -> None:
    file = tmp_path / "regions.toml"
    skin = FakeSkin("torso", placed_structure())
    skin.values = idle(skin.structure)
    with publishing(skin), painting("palm", "-o", str(file)) as paint:
        ready = paint.wait_for("ready")
        skin.values = pressed(skin.structure, BLOCK)
        going_on = paint.wait_for("painting")
        paint.press_enter()
        check("`skin-regions paint`", ready, going_on, paint.wait_for("done"))
        check("`skin-regions list`", *printing(regions, "list", str(file)))


@pytest.mark.thorough
def test_a_recording(printing: Print, tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    with publishing(FakeSkin("torso")):
        with running("skin-record", "torso", "-o", str(file)) as record:
            ready = record.wait_for("ready")
            status = record.wait_for("status", lambda status: bool(status["messages"]))
            check("`skin-record`", ready, status, record.stop())
    check("`skin-recover`", *printing(recover, str(file)))
    converted = [*printing(convert, str(file), "--to", "csv"), *printing(convert, str(file), "--to", "lerobot")]
    check("`skin-convert`", *converted)
    check("`skin-replay`", *printing(replay, str(file), "--speed", "2"))
    wire = tmp_path / "wire.mcap"
    write_recording(wire, lambda taps: keep(taps, "torso", "can0", ON_VCAN1))
    check("`skin-replay --wire`", *printing(replay, str(wire), "--wire", "--bus", "can+virtual:json"))


@pytest.mark.thorough
def test_bridge(namespace: Namespace) -> None:
    here, port = f"{namespace.name}-here", free_port()
    own, other = f"tcp/127.0.0.1:{port}", "tcp/127.0.0.1:9"
    serving = ("skin-bridge", "serve", "--robot", "r", "--listen", own, "--connect", other)
    joining = ("skin-bridge", "join", "r", "--connect", f"tcp/127.0.0.1:{port}", "--into", here)
    try:
        with publishing(FakeSkin("torso")), running(*joining) as join:
            ready = join.wait_for("ready")
            trouble = join.wait_for("trouble")
            unknown = join.wait_for("status", lambda status: status["clock"] is None)
            with running(*serving) as serve:
                seen = [join.wait_for(event) for event in ("connected", "mode")]
                seen.append(join.wait_for("status", lambda status: _has_ages(status["services"])))
                check(
                    "`skin-bridge serve`",
                    serve.wait_for("ready"),
                    serve.wait_for("status", lambda status: bool(status["services"])),
                )
            seen.append(join.wait_for("disconnected"))
            seen.append(join.wait_for("status", lambda status: not _has_ages(status["services"])))
            check("`skin-bridge join`", ready, trouble, unknown, *seen)
    finally:
        shutil.rmtree(Namespace(here).path, ignore_errors=True)


@pytest.mark.thorough
def test_many_robots() -> None:
    at = f"tcp/127.0.0.1:{free_port()}"
    routing = ("skin-bridge", "route", "--listen", at, "--connect", "tcp/127.0.0.1:9")
    watching = ("skin-bridge", "list", "--connect", at, "--watch")
    skin = FakeSkin("torso")
    skin.patch_state[1] = PatchState.STALE
    with running(*watching) as nobody:
        alone = nobody.wait_for("status", lambda status: bool(status["problems"]))
    with running(*routing) as router, publishing(skin), running(*watching) as listing:
        ready = router.wait_for("ready")
        with running("skin-bridge", "serve", "--robot", "r", "--connect", at):
            seen = [listing.wait_for("ready"), listing.wait_for("status", _is_known)]
            check("`skin-bridge route`", ready, router.wait_for("status", lambda status: bool(status["robots"])))
    check("`skin-bridge list`", alone, *seen)


def _is_known(status: dict[str, Any]) -> bool:
    return any(robot["clock"] and robot.get("drivers") for robot in status["robots"])


@pytest.mark.thorough
def test_ros2(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    own_domain(namespace, monkeypatch)
    with publishing(FakeSkin("torso")), running("skin-bridge", "ros2") as bridge:
        told = [bridge.wait_for("ready"), bridge.wait_for("status", lambda status: "torso" in status["drivers"])]
    with running("skin-bridge", "ros2", "--rmw", "zenoh", "--connect", f"tcp/127.0.0.1:{free_port()}") as bridge:
        check("`skin-bridge ros2`", *told, bridge.wait_for("router"))


@pytest.mark.thorough
def test_other_viewers(tmp_path: Path) -> None:
    with running("skin-bridge", "rerun", "-o", f"{tmp_path}/skin.rrd") as bridge:
        check("`skin-bridge rerun`, `skin-bridge foxglove`", bridge.wait_for("ready"))


@pytest.mark.thorough
def test_bridge_to_yarp() -> None:
    with robot(until_gone) as yarp, publishing(FakeSkin("torso")):
        with running("skin-bridge", "yarp", "--server", f"{LOCAL}:{yarp.server.port}", "--full-scale", "9") as bridge:
            begun = [bridge.wait_for(event) for event in ("ready", "port")]
            wait_until(lambda: "/skinware/torso" in yarp.ports)
            host, number, _ = yarp.ports["/skinware/torso"]
            with socket.create_connection((host, number), 30) as reader:
                reader.sendall(b"CONNECT reader\nr\n")
                read = bridge.wait_for("status", lambda event: bool(event["ports"]["/skinware/torso"]["readers"]))
            yarp.ports["/skinware/torso"] = ("10.0.0.9", 1, "tcp")
            check("`skin-bridge yarp`", *begun, read, bridge.wait_for("trouble"))


def _has_ages(services: dict[str, Any]) -> bool:
    return any(service["age_ms"]["p50"] is not None for service in services.values())


@pytest.mark.thorough
def test_view() -> None:
    with running("skin-view", "torso", "--port", "0", "--no-browser") as view:
        check("`skin-view`", view.wait_for("ready"))


@pytest.mark.thorough
def test_calibrate(printing: Print, tmp_path: Path) -> None:
    surface, _ = strokes()
    file = tmp_path / "skin.toml"
    with publishing(calm_skin(surface)) as skin, running("skin-calibrate", "topology", "-o", str(file)) as topology:
        live = [topology.wait_for("ready"), topology.wait_for("progress"), topology.stop()]
        stroked_state(file, skin.structure)
        live += printing(calibrate, "topology", "-o", str(file), "-T", "0")
        for follows in (True, False):
            gathered(tmp_path / "curves.toml", force_session(len(surface), follows=follows), skin.structure)
            live += printing(
                calibrate, "force", "-o", str(tmp_path / "curves.toml"), "-T", "0", status=int(not follows)
            )
        drifting, touched = PressSession(len(surface)), tmp_path / "touched.toml"
        drifting.presses = with_tool(surface, presses(surface, 1), 1, Tool(drift_m=(0.01, 0, 0)))
        gathered(touched, drifting, skin.structure)
        with ServiceWriter("robot", {"point_m": ("<f8", 3)}):
            live += printing(calibrate, "touch", "--poses", "robot", "-o", str(touched), "-T", "0")
        wrong = skin.structure.geometry
        assert wrong is not None
        wrong.position_m[:] = np.roll(wrong.position_m, len(surface) // 2, axis=0)  # exchanged patches
        wrong.position_m[3] = wrong.position_m[4]
        file.write_text(geometry_to_toml(wrong.to_groups()))
        live += printing(calibrate, "check", str(file), "-T", "0", status=1)
    with finger_presses(tmp_path / "finger.toml", surface) as arguments:
        check("`skin-calibrate`", *live, *printing(calibrate, *arguments[:-1]))


class _Stop:
    """Sets the bus down for a while, and ends the emulation."""

    def __init__(self, bus: HostBus) -> None:
        self.bus, self.turns, self.stopped = bus, 0, False

    def fileno(self) -> int:
        return -1

    def wait(self, _descriptors: list[int], _timeout_s: float | None) -> None:
        self.turns += 1
        self.bus.time_ns += 100_000_000
        self.bus.up = not 20 < self.turns < 30
        self.stopped = self.turns > 100


@pytest.mark.thorough
def test_press(printing: Print) -> None:
    with running("skin-driver", "--bus", VIRTUAL) as driver:
        driver.wait_for("ready")
        check("`skin-press`", *printing(press, "0.07", "0.0225", "0"))


@pytest.mark.thorough
def test_a_capture_and_a_proof(tmp_path: Path) -> None:
    with running("skin-driver", "--driver", "xela", "--bus", "virtual", "--capture", f"{tmp_path}/it.mcap") as driver:
        driver.wait_for("ready")
        options = ("--rest", "1", "--timeout", "0.1", "--only", "taxel 3", "--only", "xela", "-o", f"{tmp_path}/proof")
        with running("skin-prove", "xela", *options) as prove:
            step = prove.wait_for("step")
            done = prove.wait_for("done")
        check("`captured`", driver.stop())
    same, other = _compared(f"{tmp_path}/it.mcap"), _compared(f"{tmp_path}/it.mcap", "--", "--rows", "2")
    check("`skin-prove`", step, done, same, other)


def _compared(file: str, *options: str) -> Any:
    return json.loads(run("skin-prove", "--captured", file, "--json", *options).stdout)


def test_an_emulation() -> None:
    out, bus = io.StringIO(), HostBus()
    stop = _Stop(bus)
    options = EmulatedRoboskinOptions(boards=(7,), streaming=True)
    report = report_to(out, as_json=True)
    emulation = Emulation(bus, EmulatedRoboskin(options), report, clock=lambda: bus.time_ns, poll=stop.wait)
    emulation.run(stop, bus_name="host", driver="roboskin", options=options)
    printed = [json.loads(line) for line in out.getvalue().splitlines()]
    assert {one["event"] for one in printed} == {"ready", "status", "bus_down", "bus_up", "stopped"}
    check("`skin-emulate`", *printed, open_ended=True)


def test_a_difference_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SECTIONS, "made", {"a": "integer", "b[].c": "string or null"})
    check("made", {"a": 1, "b": [{"c": None}]})
    for printed in ({"a": 1, "b": []}, {"a": "1", "b": [{"c": ""}]}, {"a": 1, "b": [{"c": ""}], "d": 1}):
        with pytest.raises(AssertionError):
            check("made", printed)


def test_every_table_of_the_page_is_compared() -> None:
    compared = set(re.findall(r'check\(\s*"(.+?)"', Path(__file__).read_text())) - {"made"}
    assert compared == {heading for heading in SECTIONS if "`" in heading}
    assert all(PARTS.values())
