"""The CANopen driver and its nodes: set up, alive, in error, lost."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest

from skinware import DriverReader, DriverSnapshot, PatchState, Status
from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware_drivers.can.canopen_patch import CanopenDriver, CanopenOptions, MappingChanged
from skinware_drivers.polling import Notice
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import CanFrame, Device
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.devices.canopen_patch import EmulatedCanopen, EmulatedCanopenOptions
from tests.drivers.bench import EXAMPLE_EDS, Bench, Case, play
from tests.sdk.driving import Driving, driving_lines, read_until


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"nodes": (0,)}, "different ids of 1 to 127"),
        ({"nodes": (5, 5)}, "different ids of 1 to 127"),
        ({"type": "presure"}, "did you mean 'pressure'"),
        ({"heartbeat_ms": -1}, "heartbeat_ms"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        CanopenOptions(**options)


def test_an_eds_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"EDS /nowhere\.eds: No such file"):
        CanopenDriver(CanopenOptions(eds="/nowhere.eds"))
    bad = tmp_path / "bad.eds"
    bad.write_text("[1000]\nnothing\n")
    with pytest.raises(ConfigurationError, match=r"bad\.eds cannot be read"):
        CanopenDriver(CanopenOptions(eds=str(bad)))


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage()
    with made:
        yield made


class Stage:
    """Nodes 5 and 6, driven."""

    def __init__(self, **options: Any) -> None:
        self.log: list[Any] = []
        self.hardware = EmulatedCanopen(EmulatedCanopenOptions(boot_s=0.05), log=self.log)
        self.bus = VirtualCanBus("", hardware=self.hardware)
        self.adapter = CanopenDriver(CanopenOptions(nodes=(5, 6), **options))
        self._context: Any = None

    def __enter__(self) -> Stage:
        self._context = driving_lines([(self.adapter, self.bus)], "skin")
        self.running: Driving = self._context.__enter__()
        self.reader = DriverReader("skin")
        self.read(lambda f: not f.status.any())
        return self

    def __exit__(self, *raised: object) -> None:
        self.reader.close()
        self._context.__exit__(None, None, None)
        del self.reader, self.running, self._context  # pytest keeps this object for longer than it may keep descriptors

    def read(self, condition: Any) -> DriverSnapshot:
        return read_until(self.reader, condition)

    def do(self, method: str, *arguments: Any) -> None:
        self.running.do(lambda: getattr(self.hardware, method)(*arguments, self.bus._clock()))

    def told(self, number: int) -> list[tuple[int, str]]:
        """What a node was told."""
        return [(e.identifier, e.payload) for e in self.log if e.event == "command_received" and number in e.boards]


LIVE, STALE = PatchState.LIVE, PatchState.STALE
SUSPECT = int(Status.SUSPECT)


def test_a_node_is_configured_and_started(stage: Stage) -> None:
    told = stage.told(5)
    assert told[0] == (0x605, "4000100000000000")
    assert (0x000, "8005") in told
    assert (0x605, "2b17100064000000") in told  # heartbeat every 100 ms
    assert (0x605, "2b00180514000000") in told  # event timer 20 ms
    assert told[-1] == (0x000, "0105")
    assert stage.running.status()["buses"][0]["unknown"] == 0


def test_a_node_that_boots_is_configured_at_once_and_alone(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    before = len(stage.told(5))
    stage.do("restart", 6)
    stage.read(lambda f: f.patch_state[1] != LIVE)
    stage.read(lambda f: f.patch_state.tolist() == [LIVE, LIVE] and not f.status.any())
    assert stage.told(6)[-1] == (0x000, "0106")
    assert len(stage.told(5)) == before
    assert caplog.text.count("node 6 has restarted") == 1


def test_errors_make_a_node_suspect_until_they_are_over(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    for code in (0x4210, 0x4210, 0x4210):
        stage.do("report_error", 5, code)
    stage.read(lambda f: f.status.tolist() == [SUSPECT] * 16 + [0] * 16)  # on a busy machine others are stale before
    stage.do("report_error", 5, 0)
    stage.read(lambda f: not f.status.any())
    assert caplog.text.count("node 5 reports an error: Temperature (code 4210)") == 1


def test_a_node_that_boots_after_an_error_is_sound(stage: Stage) -> None:
    stage.do("report_error", 6, 0x8110)
    stage.read(lambda f: bool(f.status[16] & SUSPECT))
    stage.do("restart", 6)
    stage.read(lambda f: not f.status.any())


@pytest.mark.thorough
def test_a_node_that_somebody_stopped_is_stale_and_started_again(stage: Stage) -> None:
    stage.running.do(lambda: stage.hardware.receive(0x000, b"\x02\x05", stage.bus._clock()))
    stage.read(lambda f: f.patch_state[0] != LIVE)
    stage.read(lambda f: f.patch_state.tolist() == [LIVE, LIVE] and not f.status.any())


def test_a_node_without_a_heartbeat_is_lost_however_seldom_it_sends() -> None:
    async def scenario() -> None:
        async with Bench(Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6), "period_ms": 60_000})) as bench:
            await bench.run(300)
            assert bench.notices == []
            bench.hardware.devices[5].stop("heartbeat")
            while not bench.notices:
                await bench.run(10)
            assert bench.notices == [("node 5", Notice.LOST)]  # once

    play(scenario())


def test_the_heartbeat_of_a_node_that_keeps_its_own_period_is_not_missed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    eds = tmp_path / "own.eds"
    head, rest = EXAMPLE_EDS.read_text().split("[1017]")
    eds.write_text(f"{head}[1017]{rest.replace('AccessType=rw', 'AccessType=ro', 1)}")

    async def scenario() -> None:
        case = Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6)}, {"eds": str(eds), "nodes": (5,)})
        async with Bench(case) as bench:
            assert isinstance(bench.adapter, CanopenDriver)
            assert bench.adapter.expects_heartbeat_of == set()
        async with Bench(Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6)})) as bench:
            assert isinstance(bench.adapter, CanopenDriver)
            assert bench.adapter.expects_heartbeat_of == {5, 6}

    play(scenario())
    assert "object 1017:0 of node 5: Attempt to write a read only object" in caplog.text


def test_a_dead_node_is_stale_and_the_other_one_goes_on(stage: Stage) -> None:
    stage.do("kill", 6)
    stage.read(lambda f: f.patch_state.tolist() == [LIVE, STALE] and not f.status[:16].any())
    stage.do("restart", 6)
    stage.read(lambda f: not f.status.any())


def test_a_node_that_comes_back_with_other_tpdos_is_not_believed(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario() -> None:
        async with Bench(Case(CanopenDriver, EmulatedCanopen)) as bench:
            node = bench.hardware.devices[5].memory["node"]
            node.set_data(0x1801, 1, (0x80000285).to_bytes(4, "little"))
            with pytest.raises(MappingChanged):
                await bench.during(bench.adapter.revive(bench.link, bench.patches[0]))

    play(scenario())
    assert "the TPDOs of node 5 have changed" in caplog.text


def test_all_nodes_are_found_if_none_is_named() -> None:
    async def scenario() -> None:
        case = Case(CanopenDriver, EmulatedCanopen, emulated={"nodes": (1, 64, 127)})
        async with Bench(case) as bench:
            assert [patch.name for patch in bench.patches] == ["node 1", "node 64", "node 127"]

    play(scenario())


def test_a_named_node_that_is_missing_is_taken_to_be_as_the_eds_says() -> None:
    async def scenario() -> None:
        async with Bench(Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6, 7)})) as bench:
            assert [len(patch.modules) for patch in bench.patches] == [4, 4, 4]
            await bench.run(100)
            assert {patch for patch, _, _ in bench.updates} == {0, 1}

    play(scenario())


def test_if_no_named_node_answers_it_is_said() -> None:
    async def scenario() -> None:
        with pytest.raises(HandshakeTimeout, match="none of the nodes 9 answers"):
            async with Bench(Case(CanopenDriver, EmulatedCanopen, {"nodes": (9,)})):
                pass

    play(scenario())


def test_tpdos_that_wait_for_sync_get_it(tmp_path: Path) -> None:
    text = re.sub(r"(\[180.sub2\]\n(?:.+\n)*DefaultValue=)0xFF", r"\g<1>0x01", EXAMPLE_EDS.read_text())
    eds = tmp_path / "sync.eds"
    eds.write_text(text)

    async def scenario() -> None:
        case = Case(CanopenDriver, EmulatedCanopen, {"eds": str(eds)}, {"eds": str(eds)})
        async with Bench(case) as bench:
            (sync,) = bench.adapter.polls
            assert (sync.identifier, sync.payload, sync.period_s) == (0x080, b"", 0.02)
            await bench.run(200)
            assert 8 <= bench.hardware.devices[5].cycle <= 11
            assert bench.fresh
            assert not any(
                p.startswith("2b0018") for e in bench.log if e.event == "command_received" for p in [e.payload or ""]
            )

    play(scenario())


def test_a_listener_learns_the_nodes_from_what_it_hears() -> None:
    hardware = EmulatedCanopen(EmulatedCanopenOptions(nodes=(17, 99), streaming=True))
    bus = VirtualCanBus("", hardware=hardware, listen_only=True)
    adapter = CanopenDriver(CanopenOptions(learn_s=0.2))
    with driving_lines([(adapter, bus)], "skin", listen_only=True), DriverReader("skin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert len(frame.values) == 32
        assert [patch.key for patch in adapter.patches] == [17, 99]


def test_a_node_of_the_canopen_package_on_python_cans_bus() -> None:
    """Nothing of ours on the other side: its SDO server, NMT, heartbeat and TPDOs are all the package's."""
    with canopen.Network() as network:
        network.NOTIFIER_CYCLE = 0.05
        network.connect(interface="virtual", channel="canopen-test")
        node = network.create_node(5, str(EXAMPLE_EDS))
        node.nmt.state = "PRE-OPERATIONAL"
        node.tpdo.read()
        for number, tpdo in node.tpdo.items():
            for at, variable in enumerate(tpdo.map):
                variable.raw = 100 * number + at
            tpdo.start(0.02)
        bus = make_bus("can+virtual:canopen-test")
        adapter = CanopenDriver(CanopenOptions(nodes=(5,)))
        with driving_lines([(adapter, bus)], "skin") as running, DriverReader("skin") as reader:
            frame = read_until(reader, lambda f: not f.status.any())
            assert frame.values.tolist() == [100 * number + at for number in (1, 2, 3, 4) for at in range(4)]
            wait_until(lambda: node.nmt.state == "OPERATIONAL")  # this node sends data before, too
            assert node.sdo[0x1017].raw == 100
            node.emcy.send(0x5000)
            read_until(reader, lambda f: bool((f.status == SUSPECT).all()))
            node.emcy.reset()
            read_until(reader, lambda f: not f.status.any())
            assert running.status()["buses"][0]["unknown"] == 0
        wait_until(lambda: node.nmt.state == "PRE-OPERATIONAL")
        node.nmt.stop_heartbeat()
    # python-can's threads of cyclic messages end a while after they were told to
    wait_until(lambda: not any(thread.name.startswith("Cyclic send task") for thread in threading.enumerate()))


class WithoutSdoReplies(EmulatedCanopen):
    """Nobody hears what node 6 answers."""

    def reply(self, device: Device, frame: CanFrame, now_ns: int) -> None:
        if frame[0] != 0x580 + 6:
            super().reply(device, frame, now_ns)


@pytest.mark.usefixtures("namespace")
def test_a_node_whose_sdo_replies_are_lost_is_shown_as_the_eds_says() -> None:
    """It sends its TPDOs all the same: their values are its own, and the other node is not disturbed."""
    with emulated_skin(CanopenDriver, WithoutSdoReplies, driver_options={"nodes": (5, 6)}) as skin:
        first = read_until(skin.reader, lambda frame: not frame.status.any())
        of_each = len(first.values) // 2
        for node in (slice(0, of_each), slice(of_each, None)):
            read_until(
                skin.reader,
                lambda frame, node=node: not frame.status.any() and (frame.values[node] != first.values[node]).any(),  # type: ignore[misc]
            )
