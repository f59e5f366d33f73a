"""Drivers of serial devices, as users see them: several ports, faults, and devices that babble."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverFrame, DriverReader
from skinware.errors import ConfigurationError
from skinware.status import BusReason, BusState, Status
from skinware_drivers.adapter import NoOptions
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.checksums import XOR
from skinware_drivers.serial.packets import LengthTable, Packet
from skinware_drivers.testing.waiting import wait_until
from tests.sdk.driving import read_until
from tests.serial.lines import N_TAXELS, FingertipDriver, data_frame, device, driving, line, receive


def fresh(frame: DriverFrame, tip: int) -> bool:
    part = slice(tip * N_TAXELS, (tip + 1) * N_TAXELS)
    return not frame.status[part].any()


def test_several_ports_feed_one_buffer_and_one_may_go_and_come_back(tmp_path: Path) -> None:
    link = tmp_path / "port"
    with line() as first, line() as second, line() as again:
        link.symlink_to(second.path)
        with device(first, "left"), driving(first.path, str(link)) as runner:
            with device(second, "right"):
                wait_until(lambda: runner.ready)
                reader = DriverReader("fingertip")
                frame = read_until(reader, lambda frame: fresh(frame, 0) and fresh(frame, 1))
                assert [bytes(name) for name in reader.structure.patch_name] == [b"left", b"right"]
                values = frame.values.reshape(2, N_TAXELS)
                assert (values == values[:, :1]).all()
            second.unplug()
            frame = read_until(reader, lambda frame: frame.bus_state[1] == BusState.GONE and fresh(frame, 0))
            read_until(reader, lambda frame: frame.status[N_TAXELS] == Status.STALE and fresh(frame, 0))
            link.unlink()
            link.symlink_to(again.path)
            with device(again, "right"):
                frame = read_until(reader, lambda frame: fresh(frame, 0) and fresh(frame, 1), 5000)
                assert frame.bus_state[1] == BusState.LIVE
            reader.close()


def test_a_port_that_babbles_takes_nothing_from_the_others() -> None:
    """Garbage as fast as a pseudo terminal carries it: more than a hundred times what a line of 3 Mbaud can."""
    garbage = os.urandom(4096)
    with line() as good, line() as mad:
        with device(good, "good") as tip, device(mad, "mad") as babbler, driving(good.path, mad.path) as runner:
            wait_until(lambda: runner.ready)
            with DriverReader("fingertip") as reader:
                read_until(reader, lambda frame: fresh(frame, 0) and fresh(frame, 1))
                babbler._flood = garbage
                before, memory = tip.value, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                bus = runner.lines[1].bus
                assert isinstance(bus, SerialBus)
                seen = bus.framing_counters.bytes_in
                values: list[int] = []
                for frame in reader.in_order(timeout_s=30):
                    if fresh(frame, 0):
                        values.append(int(frame.values[0]))
                    if (
                        tip.value > before + 100
                        and bus.framing_counters.bytes_in > seen + 3_000_000
                        and bus._is_garbled
                    ):
                        break
                wait_until(lambda: runner.lines[1].reason == BusReason.BUS_ERRORS)
                assert runner.lines[0].reason == BusReason.NONE
                assert values == sorted(values)
                assert len(set(values)) > 80
                assert bus.framing_counters.bytes_in - bus.framing_counters.skipped_bytes < 200_000
                assert len(bus._framer._rest) < 100
                grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
                assert grown < 50_000, f"{grown} KiB more"


def test_a_device_that_says_nothing_is_asked_again() -> None:
    with line() as where, driving(where.path) as runner:
        first = where.read()
        assert first == where.read()
        with device(where):
            wait_until(lambda: runner.ready)
            with DriverReader("fingertip") as reader:
                frame = read_until(reader, lambda frame: fresh(frame, 0))
                assert frame.values.dtype == np.uint16


def test_damaged_frames_are_not_shown() -> None:
    with line() as where, device(where) as tip, driving(where.path) as runner:
        wait_until(lambda: runner.ready)
        damaged = bytearray(data_frame(0xEEEE))
        damaged[4] ^= 1
        tip._flood = bytes(damaged) + data_frame(7) + bytes(damaged)
        with DriverReader("fingertip") as reader:
            read_until(reader, lambda frame: frame.values[0] == 7, 20000)
            for _, frame in zip(range(200), reader.in_order(timeout_s=30), strict=False):
                assert (frame.values == 7).all()
        assert runner.lines[0].bus.counters.errors > 200


def test_a_device_may_tell_how_its_frames_lie_in_the_stream() -> None:
    with line() as where:
        bus = SerialBus(where.path, payload_size=64)
        adapter = FingertipDriver(NoOptions())
        adapter.fit(bus)
        bus.open()
        try:
            where.write(data_frame(1))
            assert len(receive(bus, 1)[0][1]) == 2 * N_TAXELS
            adapter.change_framing(Packet(sync=b"\xf0\xc4", length=LengthTable(2, {7: 9}), checksum=XOR))
            assert adapter.payload_size == 24
            where.write(bytes.fromhex("F0C407") + b"12345" + XOR.to_bytes(bytes.fromhex("F0C407") + b"12345"))
            assert receive(bus, 1)[0][1] == b"12345"
        finally:
            bus.close()


def test_another_kind_of_bus_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="is a can bus, FingertipDriver speaks serial"):
        FingertipDriver(NoOptions()).fit(SocketCanBus("vcan0"))
