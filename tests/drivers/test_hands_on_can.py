"""Hands on CAN (and UDP) against literal bytes, made by hand from published descriptions."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from skinware import Status
from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.nominal_hand import FINGERS
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.allegro_v5 import AllegroV5Driver, AllegroV5Options, AllegroV5UdpDriver
from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.can.linkerhand_touch import PARTS, TOUCH
from skinware_drivers.description import Patch, assemble
from skinware_drivers.fields import Match
from skinware_drivers.link import Link
from skinware_drivers.registry import NamedBus, load_driver
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.devices.allegro_v5 import EmulatedAllegroV5Tips
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand
from tests.drivers.bench import Bench, BenchLoop, Case, play
from tests.drivers.frame_fuzzing import fuzz
from tests.drivers.fuzzed import FUZZED, allegro
from tests.specification.decoding import SpecifiedDecoder

RIGHT = 0x27
MS = 1_000_000


def shown(adapter: AnyAdapter, *frames: tuple[int, str] | int) -> SpecifiedDecoder:
    """What is known after these frames; a number is a pause, ms."""
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    decoder = SpecifiedDecoder([adapter.layout], tables, [adapter.period_s])
    batch = FrameBatch(4096, 8, decoder.compiled.headroom)
    time_ns = MS
    for frame in frames:
        if isinstance(frame, int):
            time_ns += frame * MS
            continue
        batch.append(0, time_ns, frame[0], bytes.fromhex(frame[1]))
        time_ns += 130_000
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


def seen(decoder: SpecifiedDecoder) -> list[int]:
    return [at for at, status in enumerate(decoder.state.status.tolist()) if status != Status.NEVER_SEEN]


SATURATED = np.uint8(Status.OUT_OF_RANGE)


# LinkerHand

THUMB = [(RIGHT, f"B1{16 * row:02X}" + "".join(f"{6 * row + column:02X}" for column in range(6))) for row in range(12)]
INDEX_10 = [
    (RIGHT, f"B2{16 * row:02X}" + "".join(f"{40 + 4 * row + column:02X}" for column in range(4))) for row in range(10)
]


def linkerhand(**options: Any) -> LinkerHandDriver:
    return LinkerHandDriver(LinkerHandOptions(hands=(RIGHT,), **{"touch": "12x6", **options}))


def test_a_matrix_of_twelve_by_six_is_twelve_frames() -> None:
    decoder = shown(linkerhand(), (RIGHT, "B1C6"), *THUMB)
    assert seen(decoder) == list(range(72))
    assert decoder.state.values[:72].tolist() == list(range(72))
    structure = decoder.tables.structure
    assert structure.n_sensors == 5 * 72
    assert [name.decode() for name in structure.module_name.tolist()] == list(FINGERS)
    assert {kind.decode() for kind in structure.module_kind.tolist()} == {"12x6"}
    assert structure.sensor_uid[72:74].tolist() == [0x27_1000, 0x27_1001]
    assert decoder.state.bus_counters.tolist() == [[1, 0, 0, 0]]  # the question is none of ours


def test_a_matrix_of_ten_by_four_is_ten_frames_of_six_bytes() -> None:
    decoder = shown(linkerhand(touch="10x4"), (RIGHT, "B2A4"), *INDEX_10)
    assert seen(decoder) == list(range(40, 80))
    assert decoder.state.values[40:80].tolist() == list(range(40, 80))


@pytest.mark.parametrize("lost", [0, 5, 11])
def test_a_matrix_with_a_lost_row_is_not_shown_and_the_next_one_is(lost: int) -> None:
    rest = [frame for row, frame in enumerate(THUMB) if row != lost]
    assert seen(shown(linkerhand(), *rest)) == []
    assert len(seen(shown(linkerhand(), *rest, 50, (RIGHT, "B1C6"), *THUMB))) == 72


def test_rows_that_came_before_the_question_are_not_joined_with_those_behind_it() -> None:
    adapter = linkerhand()
    assert seen(shown(adapter, *THUMB[:6], 50, (RIGHT, "B1C6"), *THUMB[6:])) == []
    assert seen(shown(adapter, *THUMB, 50, *THUMB[:6], 50, (RIGHT, "B1C6"), *THUMB[6:])) == list(range(72))


def test_answers_for_two_fingers_may_be_mixed() -> None:
    index = [(RIGHT, "B2" + payload[2:]) for _, payload in THUMB]
    mixed = [frame for pair in zip(THUMB, index, strict=True) for frame in pair]
    assert len(seen(shown(linkerhand(), *mixed))) == 144


def test_motion_on_the_same_identifier_is_no_touch() -> None:
    motion = ["01FF80FF10FF20", "0110203040506070", "B0", "B002", "C0004C484C3130", "B1", "", "64", "0500FF", "FF10"]
    decoder = shown(linkerhand(), *((RIGHT, payload) for payload in motion))
    assert seen(decoder) == []
    assert decoder.state.bus_counters.tolist() == [[len(motion), 0, 0, 0]]


def test_rows_of_a_wrong_length_and_of_other_hands_are_not_shown() -> None:
    decoder = shown(linkerhand(), (RIGHT, "B11000"), (RIGHT, "B1200102030405"), *((0x28, data) for _, data in THUMB))
    assert seen(decoder) == []
    assert decoder.state.bus_counters.tolist() == [[12, 2, 0, 0]]


def test_values_of_fingers_are_four_frames() -> None:
    frames = [
        (RIGHT, "20"),
        (RIGHT, "200102030405"),
        (RIGHT, "211112131415EE"),
        (RIGHT, "22 00 B4 FF 01 FF"),
        (RIGHT, "23FFFE000102"),
    ]
    decoder = shown(linkerhand(touch="fingers"), *frames)
    assert decoder.state.values.tolist() == [
        1, 2, 3, 4, 5, 0x11, 0x12, 0x13, 0x14, 0x15, 0, 0xB4, 0xFF, 1, 0xFF, 0xFF, 0xFE, 0, 1, 2,
    ]  # fmt: skip
    end = int(Status.OUT_OF_RANGE)  # of a direction: there is none
    assert decoder.state.status.tolist() == [0] * 10 + [0, 0, end, 0, end] + [end] + [0] * 4
    structure = decoder.tables.structure
    assert [t.name for t in structure.types] == ["pressure", "tangential_force", "force_direction", "proximity"]
    assert structure.sensor_uid[::5].tolist() == [0x27_0000] * 4  # the thumb's
    assert decoder.state.bus_counters.tolist() == [[1, 0, 0, 0]]


def test_values_of_fingers_by_the_other_commands() -> None:
    decoder = shown(linkerhand(touch="fingers_90"), (RIGHT, "900102030405"), (RIGHT, "200A0B0C0D0E"))
    assert decoder.state.values[:5].tolist() == [1, 2, 3, 4, 5]
    assert seen(decoder) == [0, 1, 2, 3, 4]


def runs(command: int, rows: int, columns: int, first: int) -> list[tuple[int, str]]:
    """A matrix of the third generation; its values count from ``first`` on."""
    values = [(first + cell) % 256 for cell in range(rows * columns)]
    heads = [bytes([command, *divmod(at, columns)]) for at in range(0, len(values), 5)]
    frames = [head + bytes(values[5 * nth : 5 * nth + 5]) for nth, head in enumerate(heads)]
    return [(RIGHT, frame.hex()) for frame in frames]


def test_a_whole_hand_is_runs_of_five_with_sums_behind() -> None:
    finger, palm = runs(0xB2, 23, 9, 7), runs(0xB6, 28, 20, 3)
    assert (len(finger), len(palm)) == (42, 112)
    assert finger[1:3] == [(RIGHT, "b200050c0d0e0f10"), (RIGHT, "b201011112131415")]
    assert finger[-1] == (RIGHT, "b21607d4d5")  # row 22, column 7, two values
    assert palm[5] == (RIGHT, "b601051c1d1e1f20")
    sums = (RIGHT, "B2FF270251052004")  # 551, 1313, 1056
    adapter = linkerhand(touch="hand_23x9")
    adapter._take({RIGHT: adapter._found[RIGHT]._replace(parts=PARTS)})
    decoder = shown(adapter, (RIGHT, "B2170901"), *finger, sums, (RIGHT, "B61C1401"), *palm, (RIGHT, "B6FF0102"))
    assert seen(decoder) == [*range(207, 414), *range(5 * 207, 5 * 207 + 560)]
    assert decoder.state.values[207:414].tolist() == [(7 + cell) % 256 for cell in range(207)]
    assert decoder.state.values[5 * 207 :].tolist() == [(3 + cell) % 256 for cell in range(560)]
    assert decoder.state.bus_counters.tolist() == [[4, 0, 0, 0]]  # questions and sums
    kinds = [kind.decode() for kind in decoder.tables.structure.module_kind.tolist()]
    assert kinds == ["23x9"] * 5 + ["28x20"]


@pytest.mark.parametrize("lost", [0, 20, 41])
def test_a_matrix_of_runs_with_a_lost_one_is_not_shown(lost: int) -> None:
    frames = runs(0xB1, 23, 9, 0)
    del frames[lost]
    assert seen(shown(linkerhand(touch="hand_23x9"), *frames)) == []


def test_a_whole_hand_of_the_smaller_kind() -> None:
    finger = runs(0xB1, 12, 6, 1)
    assert finger[-1] == (RIGHT, "b10b044748")
    assert seen(shown(linkerhand(touch="hand_12x6"), (RIGHT, "B10C0601"), *finger)) == list(range(72))


def listened(emulated: dict[str, Any]) -> list[Patch]:
    """What a driver that listens makes of such hands and their program."""
    found: list[Patch] = []

    async def scenario() -> None:
        async with Bench(Case(LinkerHandDriver, EmulatedLinkerHand, {}, emulated)) as bench:
            found.extend(bench.patches)
            await bench.run(400)
            assert not (bench.decoder.state.status & ~SATURATED).any()

    play(scenario())
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("touch", TOUCH)
def test_what_a_hand_has_is_heard(touch: str) -> None:
    patches = listened({"touch": touch, "hands": (0x28,), "program_ms": 100})
    expected = LinkerHandDriver(LinkerHandOptions(hands=(0x28,), touch=touch))  # type: ignore[arg-type]
    assert patches == expected.patches


@pytest.mark.thorough
@pytest.mark.parametrize("touch", ["10x4", "fingers"])
@pytest.mark.parametrize("program_ms", [15, 40, 300])
def test_how_often_a_hand_is_asked_is_learnt(touch: str, program_ms: int) -> None:
    """Far from the usual 50 ms, too: a program that asks five times as often is not too fast, a slow one not stale."""

    async def scenario() -> None:
        emulated = {"touch": touch, "program_ms": program_ms}
        async with Bench(Case(LinkerHandDriver, EmulatedLinkerHand, {}, emulated)) as bench:
            assert bench.adapter.period_s == pytest.approx(program_ms / 1e3, rel=0.35)
            await bench.run(4 * program_ms)
            assert not (bench.decoder.state.status & ~SATURATED).any()

    play(scenario())


def test_a_period_that_is_given_is_not_learnt() -> None:
    async def scenario() -> None:
        async with Bench(Case(LinkerHandDriver, EmulatedLinkerHand, {"period_ms": 90}, {"program_ms": 40})) as bench:
            assert bench.adapter.period_s == 0.09

    play(scenario())


@pytest.mark.thorough
@pytest.mark.parametrize(("touch", "palm"), [("hand_12x6", "14x16"), ("hand_23x9", "28x20"), ("12x6", "12x6")])
def test_a_palm_is_heard(touch: str, palm: str) -> None:
    (hand,) = listened({"touch": touch, "palm": True, "program_ms": 100})
    assert [module.kind for module in hand.modules] == [touch.removeprefix("hand_")] * 5 + [palm]


def test_two_hands_on_one_bus() -> None:
    adapter = LinkerHandDriver(LinkerHandOptions(touch="12x6"))
    decoder = shown(adapter, *((0x28, payload) for _, payload in THUMB))
    assert [patch.name for patch in adapter.patches] == ["right hand", "left hand"]
    assert seen(decoder) == list(range(360, 432))


@pytest.mark.parametrize("options", [{"touch": touch} for touch in TOUCH])
def test_every_sensor_has_a_place_of_its_hand(options: dict[str, Any]) -> None:
    adapter = LinkerHandDriver(LinkerHandOptions(**options))
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    assert adapter.geometry is not None
    structure = tables.placed(adapter.geometry).structure
    for one in structure.types:
        places = adapter.geometry.of(structure, one.name)
        assert places.known.all()
        thumb = places.uid >> np.uint64(12) & np.uint64(7) == 0
        of_right = places.uid >> np.uint64(16) == RIGHT
        assert (places.position_m[thumb & of_right, 0] > 0).all()
        assert (places.position_m[thumb & ~of_right, 0] < 0).all()


def asked(emulated: dict[str, Any], **options: Any) -> list[Patch]:
    """What a driver that asks makes of such hands."""
    found: list[Patch] = []

    async def scenario() -> None:
        case = Case(LinkerHandDriver, EmulatedLinkerHand, {"ask": True, **options}, {"program_ms": 0, **emulated})
        async with Bench(case) as bench:
            found.extend(bench.patches)

    play(scenario())
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("touch", TOUCH)
@pytest.mark.parametrize("mute", [(), (0xB0,)])
def test_what_a_hand_has_is_asked(touch: str, mute: Sequence[int]) -> None:
    patches = asked({"touch": touch, "mute": mute, "hands": (0x28,)})
    assert [patch.name for patch in patches] == ["left hand"]
    expected = LinkerHandDriver(LinkerHandOptions(hands=(0x28,), touch=touch))  # type: ignore[arg-type]
    assert patches == expected.patches


def test_a_palm_is_found_by_its_answer() -> None:
    (hand,) = asked({"palm": True})
    assert [module.name for module in hand.modules] == [*FINGERS, "palm"]


def test_two_hands_are_asked_one_after_the_other() -> None:
    assert [patch.key for patch in asked({"hands": (0x27, 0x28)})] == [0x27, 0x28]


def test_a_hand_that_ignores_all_questions_is_not_there() -> None:
    with pytest.raises(HandshakeTimeout, match="no hand with touch answers at 027, 028"):
        asked({"mute": tuple(range(256))})


@pytest.mark.parametrize(("kind", "words"), [("00", "it has none"), ("06", "not over CAN")])
def test_touch_that_cannot_be_read_is_refused_with_the_reason(kind: str, words: str) -> None:
    loop = BenchLoop()

    class Link0(Link):
        async def request(self, identifier: int, payload: bytes, reply: Match, **_: Any) -> Any:
            assert (identifier, payload) == (RIGHT, b"\xb0")
            return type("Reply", (), {"payload": bytes.fromhex("B0" + kind)})

    link = Link0(VirtualCanBus("linkerhand"))
    with pytest.raises(BusError, match=words), asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(linkerhand(ask=True, touch="auto").describe(link))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hands": (0x27, 0x27)}, "give different"),
        ({"hands": (0x800,)}, "1 to 0x7FF"),
        ({"period_ms": 1}, "period_ms=1"),
    ],
)
def test_linkerhand_options_that_cannot_be(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        LinkerHandOptions(**options)


class Others(Link):
    """A bus on which some frames are heard."""

    def __init__(self, *frames: tuple[int, str]) -> None:
        super().__init__(VirtualCanBus("linkerhand"))
        self._frames = frames

    def pass_on(self) -> None:
        """All of them, as the runner does."""
        batch = FrameBatch(64)
        for identifier, payload in self._frames:
            batch.append(0, MS, identifier, bytes.fromhex(payload))
        self.offer(batch, np.arange(batch.start, batch.stop))


@pytest.mark.parametrize(("ask", "frames", "n_lines"), [(True, 3, 1), (True, 0, 0), (False, 3, 0)])
def test_a_driver_that_asks_tells_once_if_another_program_asks_too(
    ask: bool, frames: int, n_lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    link = Others((RIGHT, "01FF80FF10FF20"), *[(RIGHT, "B3C6")] * frames)

    async def scenario() -> None:
        task = asyncio.create_task(linkerhand(ask=ask).attend(link))
        await asyncio.sleep(0)
        assert link.is_listening  # nothing of this is a stranger's
        link.pass_on()
        await asyncio.sleep(0)
        assert not task.done()
        task.cancel()

    with caplog.at_level(logging.WARNING, "skinware.driver"):
        asyncio.run(scenario())
    assert [line for line in caplog.messages if "another program asks right hand" in line] == caplog.messages
    assert len(caplog.messages) == n_lines


def test_the_serial_number_is_asked_for() -> None:
    async def scenario() -> None:
        case = Case(LinkerHandDriver, EmulatedLinkerHand, {"ask": True}, {"program_ms": 0})
        async with Bench(case) as bench:
            assert isinstance(bench.adapter, LinkerHandDriver)
            told = await bench.during(bench.adapter.serial_number(bench.link, bench.patches))
            assert told == {"right hand": "LHL10-010-014-R-B-1-A"}

    play(scenario())


# Allegro V5


def pascals(decoder: SpecifiedDecoder) -> list[float]:
    told: list[float] = decoder.tables.structure.physical(decoder.state.values, "pressure").tolist()
    return told


@pytest.mark.parametrize(("first", "second"), [(0x3C0, 0x3C8), (0x140, 0x148)])
def test_fingertips_are_two_frames_of_two_pressures(first: int, second: int) -> None:
    decoder = shown(allegro("tips"), (first, "E803000000000000"), (second, "FFFFFFFF88130000"))
    assert pascals(decoder) == [1000, 0, -1, 5000]
    assert decoder.tables.structure.sensor_uid.tolist() == [0, 1, 2, 3]
    assert seen(decoder) == [0, 1, 2, 3]


def test_the_pressure_of_the_air_can_be_zero() -> None:
    decoder = shown(allegro("tips", zero_pa=101_325), (0x3C0, "CD8B0100CD8B0100"))
    assert pascals(decoder)[:2] == [0, 0]


@pytest.mark.parametrize(("zero_pa", "air_pa", "n_lines"), [(0, 101_325, 1), (101_325, 101_325, 0), (0, 0, 0)])
def test_tips_that_seem_to_send_the_pressure_of_the_air_are_told(
    zero_pa: int, air_pa: int, n_lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        case = Case(AllegroV5Driver, EmulatedAllegroV5Tips, {"zero_pa": zero_pa}, {"air_pa": air_pa})
        async with Bench(case) as bench:
            assert [module.kind for module in bench.patches[0].modules] == ["tips", "tips"]

    with caplog.at_level(logging.WARNING, "skinware.driver"):
        play(scenario())
    assert len([line for line in caplog.messages if "as if it were the pressure of the air" in line]) == n_lines


def test_pads_are_two_frames_of_eight_bytes() -> None:
    decoder = shown(allegro("sense"), (0x150, "0001FE0000000005"), (0x154, "0A000000000000FF"))
    assert pascals(decoder)[:3] == [0, 400, 254 * 400]
    assert pascals(decoder)[7:9] == [2000, 4000]
    end, none = int(Status.OUT_OF_RANGE), int(Status.NO_ACK)
    assert decoder.state.status.tolist() == [0, 0, end, *[0] * 12, none]


def test_the_unit_of_a_palm_can_be_ten_times_that_of_the_others() -> None:
    frames = ((0x150, "7B00000000000000"), (0x154, "7B00000000000000"))
    assert pascals(shown(allegro("sense", palm="tenfold"), *frames))[0:9:4] == [492_000, 0, 49_200]
    assert pascals(shown(allegro("sense"), *frames))[0:9:4] == [49_200, 0, 49_200]
    ends = shown(allegro("sense", palm="tenfold"), (0x150, "FEFFFD0000000000"), (0x154, "FFFE000000000000"))
    end, none = int(Status.OUT_OF_RANGE), int(Status.NO_ACK)
    assert ends.state.status[[0, 1, 2, 8, 9]].tolist() == [end, none, 0, none, end]


@pytest.mark.parametrize("frame", [(0x158, "00" * 8), (0x3C0, "00" * 7), (0x3C4, "00" * 8)])
def test_what_is_no_skin_of_an_allegro_is_not_shown(frame: tuple[int, str]) -> None:
    assert seen(shown(allegro("tips"), frame)) == []


def test_a_hand_of_which_nothing_is_heard_is_waited_for() -> None:
    with pytest.raises(HandshakeTimeout, match="its own program has to set a period"):
        allegro("auto")


@pytest.mark.parametrize(
    ("counted", "refused"),
    [
        ({0x3C0: 50, 0x3C8: 50}, None),
        ({0x140: 50, 0x148: 50}, None),
        ({0x3C0: 50, 0x3C8: 50, 0x140: 50, 0x148: 50}, "140 and 148 and 3C0 and 3C8"),
        ({0x3C0: 50, 0x150: 50}, "150 and 3C0"),
    ],
)
def test_two_allegro_hands_that_send_different_identifiers_are_refused(
    counted: dict[int, int], refused: str | None
) -> None:
    driver, link = AllegroV5Driver(AllegroV5Options()), Link(VirtualCanBus("allegro_v5"))
    if refused is None:
        driver._refuse_two(link, Counter(counted))
        return
    with pytest.raises(BusError, match=f"{refused} are heard, which no single hand sends"):
        driver._refuse_two(link, Counter(counted))


@pytest.mark.parametrize(("times", "warned"), [(50, False), (74, False), (100, True)])
def test_two_allegro_hands_alike_are_warned_of(times: int, warned: bool, caplog: pytest.LogCaptureFixture) -> None:
    """In half a second, of messages every 10 ms."""
    driver, link = AllegroV5Driver(AllegroV5Options()), Link(VirtualCanBus("allegro_v5"))
    driver._refuse_two(link, Counter({0x150: times, 0x154: times}))
    assert ("if two hands are on this bus, their values mix" in caplog.text) == warned


DATAGRAM = (
    "56354232 01 02 A400 07000000 10270000"  # magic, version, type, 164 bytes, number, ms
    "09000000"
    + "FFFF" * 16
    + "0100" * 16  # sample, positions, currents
    + "".join(f"{100 * pad + 1:04X}"[2:] + f"{100 * pad + 1:04X}"[:2] for pad in range(16))
    + "01000000" * 16
)


def of_datagrams(*datagrams: str) -> SpecifiedDecoder:
    adapter = AllegroV5UdpDriver(AllegroV5Options())
    framer = adapter.framing.framer()
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    decoder = SpecifiedDecoder([adapter.layout], tables)
    batch = FrameBatch(64, adapter.payload_size)
    for number, datagram in enumerate(datagrams):
        for frame in framer.feed(bytes.fromhex(datagram)):
            batch.append(0, MS * (1 + number), frame.identifier, frame.body)
    updates, _ = decoder.decode(batch)
    decoder.state.show(updates)
    return decoder


def test_a_datagram_is_a_sample_of_sixteen_pads() -> None:
    assert len(bytes.fromhex(DATAGRAM)) == 180
    decoder = of_datagrams(DATAGRAM)
    assert decoder.state.values.tolist() == [100 * pad + 1 for pad in range(16)]
    assert pascals(decoder)[1] == 10_100
    assert not decoder.state.status.any()
    doubtful = of_datagrams(DATAGRAM.replace("0100" * 16 + "0100", "0100" * 16 + "FFFF"))
    assert doubtful.state.status.tolist() == [int(Status.SUSPECT), *[0] * 15]


def test_lost_samples_are_counted_by_their_numbers() -> None:
    later = [DATAGRAM.replace("09000000" + "FFFF", f"{number:02X}000000FFFF") for number in (10, 13, 14)]
    decoder = of_datagrams(DATAGRAM, *later)
    assert decoder.state.patch_counters[0, 3] == 2  # 11 and 12


@pytest.mark.parametrize(
    "datagram",
    [
        DATAGRAM.replace("01 02 A400", "01 03 A400"),
        DATAGRAM.replace("01 02 A400", "02 02 A400"),
        DATAGRAM[:-2],
        DATAGRAM + "00",
    ],
    ids=["type", "version", "short", "long"],
)
def test_other_datagrams_are_counted_and_not_shown(datagram: str) -> None:
    decoder = of_datagrams(datagram)
    assert seen(decoder) == []
    assert decoder.state.bus_counters[0, :3].sum() == 1
    assert seen(of_datagrams(datagram, DATAGRAM)) == list(range(16))


def test_one_name_stands_for_both_kinds_of_bus() -> None:
    driver = load_driver("allegro_v5")
    assert driver is AllegroV5Driver
    assert NamedBus("virtual", "allegro_v5").choose(driver) is AllegroV5Driver
    assert NamedBus("vcan0", "allegro_v5").choose(driver) is AllegroV5Driver
    assert NamedBus("udp://:8000", "allegro_v5").choose(driver) is AllegroV5UdpDriver
    assert NamedBus("virtual:allegro_v5_udp", "allegro_v5").choose(driver) is AllegroV5UdpDriver
    assert NamedBus("udp://:8000", "linkerhand").choose(LinkerHandDriver) is LinkerHandDriver


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("model", ["tips", "sense"])
def test_every_pad_has_a_place(model: str, side: str) -> None:
    adapter = allegro(model, side=side)
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    assert adapter.geometry is not None
    assert tables.placed(adapter.geometry).structure.geometry is not None
    assert sorted(adapter.geometry.uid.tolist()) == tables.structure.sensor_uid.tolist()
    assert len({tuple(place) for place in adapter.geometry.position_m.tolist()}) == len(adapter.geometry)


@pytest.mark.thorough
@pytest.mark.usefixtures("namespace")
@pytest.mark.parametrize("name", FUZZED)
def test_random_frames_raise_nothing_and_c_does_with_them_what_numpy_does(name: str) -> None:
    outcome = fuzz(FUZZED[name](), 40_000, seed=1)
    assert outcome.updates
    assert outcome.counted
