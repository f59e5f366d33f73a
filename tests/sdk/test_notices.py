"""What devices say of themselves beside their data: restarted, lost, suspect, sound."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from skinware import DriverReader, PatchState, Status
from skinware.errors import DriverError, HandshakeTimeout
from skinware.sensor_types import PRESSURE
from skinware_drivers.can import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Identifier, Match, SequenceNumber
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.polling import Notice
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import WireFrame
from tests.sdk.driving import Driving, driving_lines, follow, read_until

MS = 1_000_000


class Speaking(CanAdapter[NoOptions]):
    """Two patches of which each says with a byte what it has to say."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint8
    patches = (Patch("one", [Module(taxels(2))], key=1), Patch("two", [Module(taxels(2, first_uid=2))], key=2))
    layout = Layout([Frame("data", [Identifier(0x180, mask=0x7F0)], (2,), Values(0, "u1", 2), patch=Bits(0, 4))])

    def __init__(self, options: NoOptions) -> None:
        super().__init__(options)
        self.revived: list[str] = []
        self.probed: list[str] = []
        self.failures = 0

    async def attend(self, link: Link) -> None:
        with link.follow(Match(0x700, mask=0x7F0), Match(0x600, mask=0x7F0)) as heard:
            while True:
                frame = await heard.get()
                self.tell(self.patches[(frame.identifier & 0xF) - 1], list(Notice)[frame.payload[0]])

    async def probe(self, link: Link, patch: Patch) -> bool:
        self.probed.append(patch.name)
        return True

    async def revive(self, link: Link, patch: Patch) -> None:
        self.revived.append(patch.name)
        if self.failures:
            self.failures -= 1
            raise HandshakeTimeout("no answer")
        await link.send(0x200 | patch.key, b"\x00")


class Devices:
    """Send data every 20 ms, unless they were told to be mute until somebody sets them up."""

    def __init__(self) -> None:
        self.mute: set[int] = set()
        self.data: Callable[[int], bytes] = lambda key: bytes((key, key))
        self.says: list[tuple[int, bytes]] = []
        self._due_ns = 0

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self.mute.discard(identifier & 0xF)

    def next_due_ns(self) -> int | None:
        return self._due_ns

    def emit(self, now_ns: int) -> list[WireFrame]:
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + 20 * MS
        data = [(0x180 | key, self.data(key)) for key in (1, 2) if key not in self.mute]
        frames, self.says = [*self.says, *data], []
        return [WireFrame(now_ns, *frame) for frame in frames]

    def skip(self, now_ns: int) -> int:
        return len(self.emit(now_ns))

    def totals(self) -> dict[str, int]:
        return {}


class Stage:
    """The two patches, being driven."""

    def __init__(self, running: Driving, devices: Devices, adapter: Speaking) -> None:
        self._running, self._devices, self.adapter = running, devices, adapter

    def say(self, key: int, notice: Notice, *, mute: bool = False) -> None:
        def act() -> None:
            self._devices.says.append((0x700 | key, bytes([list(Notice).index(notice)])))
            if mute:
                self._devices.mute.add(key)

        self._running.do(act)


@pytest.fixture
def devices() -> Devices:
    return Devices()


def states(*expected: PatchState) -> Callable[..., bool]:
    return lambda frame: frame.patch_state.tolist() == list(expected)


def statuses(one: Sequence[int], two: Sequence[int]) -> Callable[..., bool]:
    return lambda frame: frame.status.tolist() == [*one, *two]


LIVE, STALE = PatchState.LIVE, PatchState.STALE
SUSPECT = [int(Status.SUSPECT)] * 2
GOOD = [0, 0]
NEW = int(Status.NEVER_SEEN | Status.SUSPECT)


def test_a_patch_that_restarted_is_set_up_at_once_and_alone(devices: Devices, caplog: pytest.LogCaptureFixture) -> None:
    adapter, bus = Speaking(NoOptions()), VirtualCanBus("", hardware=devices)
    with caplog.at_level(logging.WARNING), driving_lines([(adapter, bus)], "speaking") as running:
        with DriverReader("speaking") as reader:
            stage = Stage(running, devices, adapter)
            read_until(reader, statuses(GOOD, GOOD))
            stage.say(2, Notice.RESTARTED, mute=True)
            wait_until(lambda: adapter.revived == ["two"])
            read_until(reader, states(LIVE, LIVE))
            assert adapter.revived == ["two"]
    assert caplog.text.count("bus0: two has restarted") == 1


def test_a_set_up_that_fails_is_tried_again_for_ever(devices: Devices) -> None:
    adapter, bus = Speaking(NoOptions()), VirtualCanBus("", hardware=devices)
    adapter.failures = 2
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        read_until(reader, statuses(GOOD, GOOD))
        Stage(running, devices, adapter).say(1, Notice.RESTARTED, mute=True)
        wait_until(lambda: len(adapter.revived) == 3)
        read_until(reader, states(LIVE, LIVE))


class Slow(Speaking):
    """Its patches may be silent for minutes."""

    period_s = 100.0  # far more than a test takes


@pytest.mark.parametrize("notice", [Notice.LOST, Notice.RESTARTED])
def test_a_lost_patch_is_stale_until_its_next_data_and_a_listener_revives_none(
    devices: Devices, notice: Notice
) -> None:
    adapter, bus = Slow(NoOptions()), VirtualCanBus("", hardware=devices, listen_only=True)
    with driving_lines([(adapter, bus)], "speaking", listen_only=True) as running:
        with DriverReader("speaking") as reader:
            stage = Stage(running, devices, adapter)
            read_until(reader, states(LIVE, LIVE))
            stage.say(1, notice, mute=True)
            read_until(reader, states(STALE, LIVE))
            running.do(devices.mute.clear)
            read_until(reader, states(LIVE, LIVE))
    assert adapter.revived == []


def test_errors_make_values_suspect_until_they_are_over_or_the_patch_was_set_up(devices: Devices) -> None:
    adapter, bus = Speaking(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        stage = Stage(running, devices, adapter)
        read_until(reader, statuses(GOOD, GOOD))
        stage.say(1, Notice.SUSPECT)
        stage.say(2, Notice.SUSPECT)
        read_until(reader, statuses(SUSPECT, SUSPECT))
        stage.say(1, Notice.SOUND)
        read_until(reader, statuses(GOOD, SUSPECT))
        stage.say(2, Notice.RESTARTED, mute=True)
        read_until(reader, statuses(GOOD, GOOD))
        assert adapter.revived == ["two"]


def test_what_is_told_of_oneself_is_no_unknown_frame(devices: Devices) -> None:
    adapter, bus = Speaking(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        Stage(running, devices, adapter).say(1, Notice.SUSPECT)
        read_until(reader, statuses(SUSPECT, GOOD))
        assert running.status()["buses"][0]["unknown"] == 0


def test_a_patch_that_restarts_again_while_it_is_set_up_is_found(devices: Devices) -> None:
    class Hasty(Speaking):
        async def revive(self, link: Link, patch: Patch) -> None:
            await super().revive(link, patch)
            if len(self.revived) == 1:
                devices.mute.add(patch.key)  # it loses its configuration again, without a word

    adapter, bus = Hasty(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        read_until(reader, statuses(GOOD, GOOD))
        Stage(running, devices, adapter).say(1, Notice.RESTARTED, mute=True)
        wait_until(lambda: len(adapter.revived) == 2)
        read_until(reader, states(LIVE, LIVE))


def test_an_adapter_that_fails_while_it_attends_ends_the_driver(devices: Devices) -> None:
    class Broken(Speaking):
        async def attend(self, link: Link) -> None:
            raise ZeroDivisionError("a bug")

    lines = [(Broken(NoOptions()), VirtualCanBus("", hardware=devices))]
    ended_by_itself: list[bool] = []

    def see_it_end(running: Driving) -> None:
        wait_until(lambda: running.failure is not None)
        ended_by_itself.append(True)

    with (
        pytest.raises(DriverError, match=r"^bus bus0: `attend` failed: .*a bug"),
        driving_lines(lines, "speaking", wait=False) as running,
    ):
        see_it_end(running)
    assert ended_by_itself


def test_a_patch_that_changed_is_asked_anew_until_what_it_says_makes_sense(
    devices: Devices, caplog: pytest.LogCaptureFixture
) -> None:
    class Changing(Speaking):
        async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
            return answers.pop(0)()

    def nothing() -> Sequence[Patch]:
        raise HandshakeTimeout("no answer")

    one, two = Speaking.patches
    three = Patch("three", [Module(taxels(2, first_uid=4))], key=3)
    answers: list[Callable[[], Sequence[Patch]]] = [nothing, lambda: (one, one), lambda: (one, two, three)]
    adapter, bus = Changing(NoOptions()), VirtualCanBus("", hardware=devices)
    with (
        caplog.at_level(logging.WARNING),
        driving_lines([(adapter, bus)], "speaking") as running,
        DriverReader("speaking") as reader,
    ):
        stage = Stage(running, devices, adapter)
        first = read_until(reader, statuses(GOOD, GOOD))
        stage.say(1, Notice.CHANGED)
        wait_until(lambda: "bus0: nothing joined: no answer" in caplog.text)
        stage.say(1, Notice.CHANGED)
        wait_until(lambda: "the devices that were found do not form a valid skin: " in caplog.text)
        same = read_until(reader, lambda f: f.patch_state.tolist() == [LIVE, LIVE] and f.sequence > first.sequence + 3)
        assert same.generation == first.generation
        stage.say(2, Notice.SUSPECT)
        read_until(reader, statuses(GOOD, SUSPECT))
        stage.say(1, Notice.CHANGED)
        joined = follow(reader, lambda f: f.structure.n_patches == 3 and not f.status[:2].any() and f.status[2] != NEW)
        assert joined.status[2:4].tolist() == SUSPECT  # it still is
        assert [bytes(name) for name in joined.structure.patch_name] == [b"one", b"two", b"three"]


def test_an_adapter_whose_bus_fails_while_it_attends_attends_again(devices: Devices) -> None:
    class Shaky(Speaking):
        failures_to_attend = 2
        attends = False

        async def attend(self, link: Link) -> None:
            if self.failures_to_attend:
                self.failures_to_attend -= 1
                raise HandshakeTimeout("no answer")
            self.attends = True
            await super().attend(link)

    adapter, bus = Shaky(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        wait_until(lambda: adapter.attends)
        Stage(running, devices, adapter).say(1, Notice.SUSPECT)
        read_until(reader, statuses(SUSPECT, GOOD))


def test_nobody_is_probed_while_the_devices_of_a_bus_are_being_set_up(devices: Devices) -> None:
    adapter, bus = Speaking(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        read_until(reader, statuses(GOOD, GOOD))
        runner = running.runner
        assert runner is not None
        busy = runner.lines[0].busy
        running.do(lambda: asyncio.ensure_future(busy.acquire()))
        running.do(lambda: devices.mute.add(1))
        stale = read_until(reader, states(STALE, LIVE))
        read_until(reader, lambda f: f.sequence > stale.sequence + 50)  # several times as long as a patch may be silent
        assert adapter.probed == []
        running.do(busy.release)
        read_until(reader, states(LIVE, LIVE))
        assert adapter.revived == ["one"]


def test_sequence_numbers_of_a_patch_that_was_set_up_anew_begin_anew(devices: Devices) -> None:
    class Counting(Speaking):
        layout = Layout(
            [
                Frame(
                    "data",
                    [Identifier(0x180, mask=0x7F0)],
                    (3,),
                    Values(1, "u1", 2),
                    patch=Bits(0, 4),
                    sequence=SequenceNumber(0, "u1"),
                )
            ]
        )

    numbers = {1: 100, 2: 100}

    def data(key: int) -> bytes:
        numbers[key] += 1
        return bytes((numbers[key] % 256, key, key))

    devices.data = data
    adapter, bus = Counting(NoOptions()), VirtualCanBus("", hardware=devices)
    with driving_lines([(adapter, bus)], "speaking") as running, DriverReader("speaking") as reader:
        read_until(reader, statuses(GOOD, GOOD))

        def restart() -> None:
            numbers[1] += 50  # from wherever it begins anew
            devices.mute.add(1)

        running.do(restart)
        Stage(running, devices, adapter).say(1, Notice.RESTARTED)
        wait_until(lambda: adapter.revived == ["one"])
        read_until(reader, states(LIVE, LIVE))
        counters = reader.patch_counters(reader.read())[0]
        assert (counters["sequence_lost"], counters["sequence_back"]) == (0, 0)
