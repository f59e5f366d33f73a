"""Frames that C takes from a socket into the ring while the event loop rests.

Datagrams of the loopback stand in for CAN: emulated boards at one end, the driver at the other.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from skinware import BusReason, BusState, DriverReader, Status
from skinware.errors import DriverError
from skinware.status import DataPath
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, FrameBatch
from skinware_drivers.can.roboskin import BaselineWatch, RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.native.structs import Source
from skinware_drivers.polling import Watch
from skinware_drivers.running.generation import FlowLoop, FlowSelector
from skinware_drivers.running.runner import Runner
from skinware_drivers.testing.driving import Driving, carried_on, driving_lines
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions
from tests.sdk.cable import Cable
from tests.sdk.driving import emulated, follow

BOARDS = (3, 7)


class EndOfCable(SocketCanBus):
    """One end of a cable, which can be opened again."""

    def __init__(self, end: socket.socket, **options: str) -> None:
        super().__init__("cable", options)
        self._end = end

    def open(self) -> None:
        """The end is there."""
        self.adopt(socket.socket(fileno=os.dup(self._end.fileno())))


@contextmanager
def flowing(cable: Cable, driver: Any = RoboskinDriver, **options: str) -> Iterator[tuple[Driving, EndOfCable]]:
    bus, far_end = EndOfCable(cable.end, **options), EndOfCable(cable.out)
    hardware, lines = EmulatedRoboskin(EmulatorOptions(boards=BOARDS)), [(driver(RoboskinOptions()), bus)]
    with carried_on(far_end, hardware), driving_lines(lines, "roboskin") as running:
        yield running, bus


def newer_and_good(than: Any) -> Callable[[Any], bool]:
    def condition(frame: Any) -> bool:
        return not frame.status.any() and bool((frame.module_time_ns > than.module_time_ns).all())

    return condition


def test_a_driver_flows_and_its_frames_are_whole(cable: Cable) -> None:
    with flowing(cable) as (running, bus), DriverReader("roboskin") as reader:
        frame = follow(reader, lambda f: not f.status.any())
        assert frame.data_path == DataPath.NATIVE
        assert frame.structure.n_patches == len(BOARDS)
        assert frame.bus_state[0] == BusState.LIVE
        for _ in range(5):
            frame = follow(reader, newer_and_good(frame))
        wait_until(lambda: running.status()["buses"][0]["frames"] > 1000)
        counters = reader.bus_counters(reader.read())[0]
        wait_until(lambda: bus.counters.frames >= counters["frames"])
        assert counters["dropped"] == bus.counters.dropped == 0


def test_a_bus_that_c_cannot_read_is_read_beside_one_that_it_can(cable: Cable, spare_cable: Cable) -> None:
    """Whether a controller has stamps of its own is known only once it is open, which may be late."""

    class ForPython(EndOfCable):
        def hand_over(self, batch: FrameBatch, source: Source) -> bool:
            return False

    cables = cable, spare_cable
    one, other = EndOfCable(cable.end), ForPython(spare_cable.end)
    lines = [(RoboskinDriver(RoboskinOptions()), bus) for bus in (one, other)]
    with ExitStack() as stack:
        for number, end in enumerate(cables):
            hardware = EmulatedRoboskin(EmulatorOptions(boards=(BOARDS[number],)))
            stack.enter_context(carried_on(EndOfCable(end.out), hardware))
        stack.enter_context(driving_lines(lines, "roboskin"))
        reader = stack.enter_context(DriverReader("roboskin"))
        frame = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        for _ in range(5):
            frame = follow(reader, newer_and_good(frame))


def test_questions_are_answered_while_frames_flow(cable: Cable) -> None:
    with flowing(cable), DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())
        assert "bus0" in reader.call("rebaseline", timeout_s=60)
        follow(reader, lambda f: not f.status.any())


def test_requests_are_answered_with_frames_that_begin_later(cable: Cable) -> None:
    with flowing(cable), DriverReader("roboskin") as reader:
        before = follow(reader, lambda f: not f.status.any())
        for _ in range(5):
            frame = reader.request(timeout_s=30)
            assert frame.sequence > before.sequence
            assert frame.acquired_ns > before.acquired_ns
            before = frame


def test_buses_that_only_python_can_read_flow_beside_others(cable: Cable) -> None:
    lines: Sequence[Any] = [
        (RoboskinDriver(RoboskinOptions(boards=BOARDS)), EndOfCable(cable.end)),
        (RoboskinDriver(RoboskinOptions(boards=(8,))), emulated(boards=(8,))),
    ]
    with (
        carried_on(EndOfCable(cable.out), EmulatedRoboskin(EmulatorOptions(boards=BOARDS))),
        driving_lines(lines, "roboskin") as running,
    ):
        with DriverReader("roboskin") as reader:
            frame = follow(reader, lambda f: not f.status.any())
            for _ in range(5):
                frame = follow(reader, newer_and_good(frame))
        assert frame.data_path == DataPath.MIXED
        assert frame.bus_data_path.tolist() == [DataPath.NATIVE, DataPath.PYTHON]
        status = running.status()
        assert [bus["data_path"] for bus in status["buses"]] == ["native", "python"]


def test_what_is_no_data_frame_is_sorted_out(cable: Cable) -> None:
    with flowing(cable) as (running, bus), DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())
        cable.out.send(struct.pack("=IB3x8s", ERROR_FLAG | 0x4, 8, b"\0\x10"))  # error-passive
        cable.out.send(struct.pack("=IB3x8s", REMOTE_FLAG | 0x123, 0, b""))
        wait_until(lambda: (bus.counters.errors, bus.counters.refused) == (1, 1))
        follow(reader, lambda f: f.bus_reason[0] == BusReason.ERROR_PASSIVE and not f.status.any())
        assert [s["why"] for s in running.status()["buses"][0]["samples"]] == ["refused"]


def test_a_controller_that_goes_off_after_its_last_data_is_off(cable: Cable) -> None:
    with ExitStack() as boards:
        boards.enter_context(carried_on(EndOfCable(cable.out), EmulatedRoboskin(EmulatorOptions(boards=BOARDS))))
        with driving_lines([(RoboskinDriver(RoboskinOptions()), EndOfCable(cable.end))], "roboskin"):
            with DriverReader("roboskin") as reader:
                follow(reader, lambda f: not f.status.any())
                boards.close()
                cable.put(0x6F3)
                cable.put(ERROR_FLAG | 0x40)
                follow(reader, lambda f: f.bus_reason[0] == BusReason.BUS_OFF)


def test_strangers_and_wrong_frames_are_counted_and_kept_as_samples(cable: Cable) -> None:
    with flowing(cable) as (running, _), DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())
        before = running.status()["buses"][0]
        for _ in range(3):
            cable.put(0x6F3)
        cable.put(0x473, bytes(3))
        cable.put(0x473, b"\x17" + bytes(7))

        def counted() -> dict[str, int]:
            now = running.status()["buses"][0]
            return {name: now[name] - before[name] for name in ("unknown", "bad_length", "bad_content")}

        wait_until(lambda: counted() == {"unknown": 3, "bad_length": 1, "bad_content": 1})
        samples = running.status()["buses"][0]["samples"]
        assert {(s["why"], s["identifier"]) for s in samples} >= {
            ("unknown", 0x6F3),
            ("bad_length", 0x473),
            ("bad_content", 0x473),
        }


def test_losses_are_counted_and_nothing_is_joined_over_them(cable: Cable) -> None:
    with flowing(cable, buffer="40000") as (running, bus), DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())

        def flood() -> None:  # in the driver's thread: nothing is taken meanwhile
            for _ in range(2000):
                cable.put(0x6F3)

        running.do(flood)
        wait_until(lambda: bus.counters.dropped > 0)
        frame = follow(reader, lambda f: not f.status.any())
        wait_until(lambda: reader.bus_counters(reader.read())[0]["dropped"] == bus.counters.dropped)
        assert frame.data_path == DataPath.NATIVE


def test_boards_that_fall_silent_go_stale_though_nothing_wakes_the_driver(cable: Cable) -> None:
    hardware = EmulatedRoboskin(EmulatorOptions(boards=BOARDS))
    bus = EndOfCable(cable.end)
    lines: Sequence[Any] = [(RoboskinDriver(RoboskinOptions()), bus)]
    with driving_lines(lines, "roboskin", wait=False) as running:
        with carried_on(EndOfCable(cable.out), hardware):
            running.wait()
            with DriverReader("roboskin") as reader:
                follow(reader, lambda f: not f.status.any())
        with DriverReader("roboskin") as reader:
            follow(reader, lambda f: bool((f.status & int(Status.STALE) != 0).all()))
            follow(reader, lambda f: f.bus_state[0] == BusState.SILENT)


class Failing(BaselineWatch):
    def look(self, updates: Updates) -> None:
        raise KeyError("oops")


class Watched(RoboskinDriver):
    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        return Failing(tables)


def test_a_watch_that_fails_ends_the_driver(cable: Cable) -> None:
    looks = itertools.count()

    def flag_until_it_ends() -> None:
        with flowing(cable, Watched) as (running, _):

            def has_failed() -> bool:
                if next(looks) % 14 == 0:  # again and again: the board's own halves may come between these
                    cable.out.send(struct.pack("=IB3x8s", 0x430, 8, b"\x40" + bytes(7)))
                    cable.out.send(struct.pack("=IB3x8s", 0x430, 8, b"\xc0" + bytes(5) + b"\x01\x00"))
                return running.failure is not None

            wait_until(has_failed)

    with pytest.raises(DriverError, match=r"`Watch.look` failed: KeyError: 'oops'"):
        flag_until_it_ends()


def test_in_another_loop_the_driver_takes_frames_without_the_flow(cable: Cable) -> None:
    hardware = EmulatedRoboskin(EmulatorOptions(boards=BOARDS))
    lines = [("bus0", RoboskinDriver(RoboskinOptions()), EndOfCable(cable.end))]

    async def run() -> DataPath:
        ready = asyncio.Event()
        runner = Runner("roboskin", lines, name="roboskin", on_ready=ready.set)
        running = asyncio.create_task(runner.run())
        await asyncio.wait_for(ready.wait(), 60)
        with DriverReader("roboskin") as reader:
            frame = await asyncio.to_thread(follow, reader, lambda f: not f.status.any())
        runner.stop()
        await running
        return DataPath(frame.data_path)

    with carried_on(EndOfCable(cable.out), hardware):
        assert asyncio.run(run()) == DataPath.PYTHON


def test_a_selector_without_a_flow_is_one_like_any_other() -> None:
    async def run() -> str:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, FlowLoop)
        assert isinstance(loop.selector, FlowSelector)
        await asyncio.sleep(0.001)
        return await asyncio.to_thread(lambda: "done")

    with asyncio.Runner(loop_factory=FlowLoop) as loop:
        assert loop.run(run()) == "done"
