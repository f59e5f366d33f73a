"""The CANopen driver: what TPDOs mean, and what nodes say of themselves."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import canopen
import numpy as np
import pytest

from skinware import DriverFrame, DriverReader, PatchState, Status
from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware_drivers.adapter import Notice
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.can.canopen_patch import CanopenDriver, CanopenOptions, MappingChanged
from skinware_drivers.can.pdo_map import Entry, PdoMap, Tpdo, default_tpdos
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import assemble
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.canopen_patch import EmulatedCanopen, EmulatedCanopenOptions
from skinware_drivers.virtual.events import CommandReceived, ErrorReported
from tests.drivers.bench import Bench, Case, play
from tests.sdk.driving import Driving, driving_lines, read_until

EXAMPLE = Path(str(resources.files("skinware_drivers") / "eds" / "skin_patch.eds"))
U8, I8, U16, I16, U32, I32, REAL32, BOOLEAN = 5, 2, 6, 3, 7, 4, 8, 1


def dictionary(**objects: tuple[int, int]) -> canopen.ObjectDictionary:
    """Objects by name: (index, data type)."""
    made = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for name, (index, data_type) in objects.items():
        variable = canopen.objectdictionary.ODVariable(name.replace("_", " "), index)
        variable.data_type = data_type
        made.add_object(variable)
    return made


def tpdo(number: int, cob_id: int, *entries: tuple[int, int]) -> Tpdo:
    made = Tpdo.make(number, cob_id, 255, [index << 16 | bits for index, bits in entries])
    assert made is not None
    return made


def decoded(made: PdoMap, *frames: tuple[int, str]) -> Decoder:
    decoder = Decoder([made.layout], assemble([("bus", made.patches)], made.types, made.dtype))
    batch = FrameBatch(100, 8, decoder.headroom)
    for identifier, payload in frames:
        batch.append(0, 1, identifier, bytes.fromhex(payload))
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


# What is mapped


@pytest.mark.parametrize(
    ("data_type", "bits", "payload", "values", "dtype"),
    [
        (U8, 8, "00FF", [0, 255], np.uint8),
        (I8, 8, "7F80", [127, -128], np.int16),
        (U16, 16, "FEFF0100", [65534, 1], np.uint16),
        (I16, 16, "FEFF0080", [-2, -32768], np.int16),
        (I32, 32, "FEFFFFFF00000080", [-2, -(2**31)], np.int32),
        (U32, 32, "000000010000F000", [2**24, 0xF00000], np.float32),
        (REAL32, 32, "0000C03F000020C1", [1.5, -10.0], np.float32),
    ],
)
def test_objects_of_every_type(data_type: int, bits: int, payload: str, values: list[float], dtype: Any) -> None:
    objects = dictionary(taxel_1=(0x6000, data_type), taxel_2=(0x6001, data_type))
    made = PdoMap(objects, {3: [tpdo(1, 0x183, (0x6000, bits), (0x6001, bits))]}, "pressure")
    assert made.dtype == dtype
    decoder = decoded(made, (0x183, payload))
    assert decoder.state.values.tolist() == values
    assert not decoder.state.status.any()


def test_objects_of_different_lengths_in_one_tpdo() -> None:
    objects = dictionary(a=(0x6000, U16), b=(0x6001, I8), temperature=(0x6002, I16), c=(0x6003, U8), flag=(6, BOOLEAN))
    mapped = ((0x6001, 8), (0x6000, 12), (6, 4), (0x6003, 3), (0x6002, 13), (0x6000, 16))
    made = PdoMap(objects, {3: [tpdo(1, 0x183, *mapped[:5])]}, "proximity")
    bits = (-5 & 0xFF) | 0xABC << 8 | 0xF << 20 | 5 << 24 | (-1000 & 0x1FFF) << 27
    decoder = decoded(made, (0x183, bits.to_bytes(5, "little").hex()))
    assert decoder.state.values.tolist() == [-5, 0xABC, 5, -1000]
    assert [t.name for t in made.types] == ["proximity", "temperature"]
    assert len(made.patches[0].modules[0].channels) == 5


def test_what_is_no_number_of_the_eds_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    made = PdoMap(dictionary(a=(0x6000, U8)), {3: [tpdo(1, 0x183, (0x7000, 8), (0x6000, 8))]}, "pressure")
    assert "object 7000:0 is mapped, but no number" in caplog.text
    assert decoded(made, (0x183, "0907")).state.values.tolist() == [7]
    with pytest.raises(ConfigurationError, match="none of the objects"):
        PdoMap(dictionary(), {3: [tpdo(1, 0x183, (0x7000, 8))]}, "pressure")


def test_identifiers_of_any_kind() -> None:
    objects = dictionary(a=(0x6000, U8), b=(0x6001, U8))
    nodes = {
        3: [tpdo(1, 0x183, (0x6000, 8)), tpdo(2, 0x7A0, (0x6001, 8))],
        4: [tpdo(1, 0x184, (0x6000, 8)), tpdo(2, 1 << 29 | 0x18DA0104, (0x6001, 8))],
    }
    made = PdoMap(objects, nodes, "pressure")
    frames = [(0x7A0, "02"), (0x184, "03"), (EXTENDED_FLAG | 0x18DA0104, "04"), (0x183, "01")]
    decoder = decoded(made, *frames, (0x185, "09"), (0x18DA0104 & 0x7FF, "09"))
    assert decoder.state.values.tolist() == [1, 2, 3, 4]
    assert decoder.state.bus_counters[0].tolist() == [2, 0, 0]
    assert len(made.layout.frames) == 3  # both TPDO 1 are alike


def test_nodes_that_map_the_same_identifiers_differently() -> None:
    objects = dictionary(a=(0x6000, U8), b=(0x6001, U16))
    nodes = {3: [tpdo(1, 0x183, (0x6000, 8))], 4: [tpdo(1, 0x184, (0x6001, 16))]}
    decoder = decoded(PdoMap(objects, nodes, "pressure"), (0x183, "07"), (0x184, "0102"), (0x184, "07"))
    assert decoder.state.values.tolist() == [7, 0x0201]
    assert decoder.state.bus_counters[0].tolist() == [0, 1, 0]


def test_tpdos_that_are_not_in_use() -> None:
    assert Tpdo.make(1, 1 << 31 | 0x183, 255, [0x60000008]) is None
    assert Tpdo.make(1, 0x183, 255, []) is None
    assert Entry.from_number(0x60010310) == Entry(0x6001, 3, 16)


def test_the_example_eds() -> None:
    made = PdoMap(
        canopen.import_od(str(EXAMPLE), 5), {5: default_tpdos(canopen.import_od(str(EXAMPLE), 5))}, "pressure"
    )
    (pressure, temperature) = made.types
    assert (pressure.name, pressure.unit, pressure.minimum, pressure.maximum) == ("pressure", "counts", 0, 4095)
    assert (temperature.name, temperature.unit, temperature.scale) == ("temperature", "degC", 0.1)
    assert (temperature.minimum, temperature.maximum) == (-40, 125)
    decoder = decoded(made, (0x485, "0D000E000F00E7FF"), (0x185, "0100020003000400"))
    assert decoder.state.values.tolist() == [1, 2, 3, 4, *[0] * 8, 13, 14, 15, -25]
    assert decoder.tables.structure.sensor_uid[-1] == 5 << 24 | 0x6010 << 8


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


# Nodes


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
        self.bus = VirtualCanBus.with_hardware(self.hardware)
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

    def read(self, condition: Any) -> DriverFrame:
        return read_until(self.reader, condition)

    def do(self, method: str, *arguments: Any) -> None:
        self.running.do(lambda: getattr(self.hardware, method)(*arguments, self.bus._clock()))

    def told(self, number: int) -> list[tuple[int, str]]:
        """What a node was told."""
        return [(e.identifier, e.payload) for e in self.log if isinstance(e, CommandReceived) and number in e.boards]


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
    frame = stage.read(lambda f: bool(f.status[0]))
    assert frame.status.tolist() == [SUSPECT] * 16 + [0] * 16
    stage.do("report_error", 5, 0)
    stage.read(lambda f: not f.status.any())
    assert caplog.text.count("node 5 reports an error: Temperature (code 4210)") == 1


def test_emulated_nodes_report_errors_when_told_to() -> None:
    async def scenario() -> None:
        faults = {"faulty": (6,), "faulty_after_s": 0.5, "faulty_for_s": 0.2}
        async with Bench(Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6)}), **faults) as bench:
            await bench.run(1000)
            assert bench.notices == [("node 6", Notice.SUSPECT), ("node 6", Notice.SOUND)]
            assert [e.code for e in bench.log if isinstance(e, ErrorReported)] == [0x4210, 0]

    play(scenario())
    with pytest.raises(ConfigurationError, match="option faulty: there is no device 7"):
        EmulatedCanopen(EmulatedCanopenOptions(faulty=(7,)))


def test_a_node_that_boots_after_an_error_is_sound(stage: Stage) -> None:
    stage.do("report_error", 6, 0x8110)
    stage.read(lambda f: bool(f.status[16] & SUSPECT))
    stage.do("restart", 6)
    stage.read(lambda f: not f.status.any())


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
    head, rest = EXAMPLE.read_text().split("[1017]")
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
    text = re.sub(r"(\[180.sub2\]\n(?:.+\n)*DefaultValue=)0xFF", r"\g<1>0x01", EXAMPLE.read_text())
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
                p.startswith("2b0018") for e in bench.log if isinstance(e, CommandReceived) for p in [e.payload]
            )

    play(scenario())


def test_a_listener_learns_the_nodes_from_what_it_hears() -> None:
    hardware = EmulatedCanopen(EmulatedCanopenOptions(nodes=(17, 99), streaming=True))
    bus = VirtualCanBus.with_hardware(hardware, listen_only=True)
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
        node = network.create_node(5, str(EXAMPLE))
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
            wait_until(lambda: node.nmt.state == "OPERATIONAL")
            assert node.sdo[0x1017].raw == 100
            node.emcy.send(0x5000)
            read_until(reader, lambda f: bool((f.status == SUSPECT).all()))
            node.emcy.reset()
            read_until(reader, lambda f: not f.status.any())
            assert running.status()["buses"][0]["unknown"] == 0
        wait_until(lambda: node.nmt.state == "PRE-OPERATIONAL")
        node.nmt.stop_heartbeat()
