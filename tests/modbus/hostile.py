"""Hostile devices for drivers of Modbus: whatever they reply, nothing raises, all bytes are accounted for, and the
data paths in numpy and in C make the same of it. What ``tools/fuzz hostile_devices`` does for long and the tests for a
moment.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from skinware_drivers.counters import BusCounters
from skinware_drivers.description import assemble
from skinware_drivers.link import Link
from skinware_drivers.modbus import ModbusAdapter, wire
from skinware_drivers.modbus.dfrobot import DfrobotDriver, DfrobotOptions
from skinware_drivers.modbus.inspire import InspireDriver, InspireOptions
from skinware_drivers.modbus.master import Master, Timing
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.modbus.revo2 import Revo2Driver, Revo2Options
from skinware_drivers.modbus.revo3 import Revo3Driver, Revo3Options
from skinware_drivers.modbus.wire import Message
from skinware_drivers.registry import make_bus
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.one_path import Publishing

MS = 1_000_000


def _described(adapter: ModbusAdapter[Any]) -> ModbusAdapter[Any]:
    """One that learns from its options what there is, and asks nobody."""
    asyncio.run(adapter.describe(Link(make_bus("modbus:/dev/null"))))
    return adapter


FUZZED: Mapping[str, Callable[[], ModbusAdapter[Any]]] = {
    "dfrobot": lambda: _described(DfrobotDriver(DfrobotOptions(units=(1, 2), shapes=("6x6", "4x8")))),
    "inspire": lambda: InspireDriver(InspireOptions()),
    "inspire-by_matrix": lambda: InspireDriver(InspireOptions(by_matrix=True)),
    "revo2": lambda: Revo2Driver(Revo2Options()),
    "revo2-force3d": lambda: Revo2Driver(Revo2Options(edition="force3d")),
    "revo3": lambda: Revo3Driver(Revo3Options()),
    "revo3-matrix": lambda: Revo3Driver(Revo3Options(mapping="matrix")),
    "revo3-packed": lambda: Revo3Driver(Revo3Options(mapping="packed")),
}
_ROWS = 64


def fuzz(adapter: ModbusAdapter[Any], n_bytes: int, seed: int, *, over_tcp: bool) -> Counter[str]:
    """Let a hostile device answer the questions of a driver, with so many bytes.

    Args:
        adapter: whose patches and registers are known.
        n_bytes: at least.
        seed: of what is random.
        over_tcp: in a connection, that ends where no Modbus comes; else on a line.

    Returns:
        What came, and what became of it: ``bytes``, ``rows``, ``updates``, and how often which kind of reply.
    """
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    found: Counter[str] = Counter()
    with hand_clock() as clock:
        hostile = _Hostile(adapter, np.random.default_rng(seed), clock.now_ns, over_tcp)
        periods_s, size = [adapter.period_s], adapter.payload_size
        publishing = Publishing(adapter.period_s)
        with Pair(
            clock, [adapter.layout], tables, periods_s, publishing, watch=adapter.watch, payload_size=size
        ) as pair:
            while hostile.found["bytes"] < n_bytes:
                while len(hostile.master.rows) < _ROWS and hostile.found["bytes"] < n_bytes:
                    hostile.answer()
                rows = [(0, row.time_ns, row.identifier, row.payload) for row in hostile.master.rows]
                hostile.master.rows.clear()
                pair.pass_to(hostile.now_ns)
                if rows:
                    pair.feed(rows)
                hostile.found["rows"] += len(rows)
            state = pair.numpy.decoder.state
            assert state.bus_counters[0, :3].sum() == 0, "the bus made frames that the layout does not know"
            found["updates"] = int(state.patch_counters[:, 0].sum())
        hostile.require_accounted()
    return found + hostile.found


class _Hostile:
    """Who answers a master, in every way but the expected one, and often enough in that."""

    def __init__(self, adapter: ModbusAdapter[Any], random: np.random.Generator, now_ns: int, over_tcp: bool) -> None:
        self.now_ns = now_ns
        self.found: Counter[str] = Counter()
        self._random, self._over_tcp = random, over_tcp
        self._counters = BusCounters()
        self._wanted = Wanted(
            adapter.registers,
            adapter.address_step,
            adapter.largest_gap,
            adapter.most_registers,
            adapter.byte_order,
            adapter.word_order,
        )
        self._begin()

    def answer(self) -> None:
        """Wait for a question, and reply something."""
        said = b""
        while not said:
            said = self.master.say(self.now_ns)
            if not said:
                due_ns = self.master.due_ns
                assert due_ns is not None, "it asks no more"
                self.now_ns = max(self.now_ns + 1, due_ns)
        asked = self._message(said)
        stream = b"".join(self._reply(asked) for _ in range(int(self._random.integers(1, 4))))
        at = 0
        while at < len(stream):
            size = int(self._random.choice([1, 7, 100, 300]))
            self._hear(stream[at : at + size])
            at += size

    def require_accounted(self) -> None:
        """Every byte was taken as something."""
        counters = self._counters.framing
        assert counters.bytes_in == self.found["bytes"]
        taken = counters.frame_bytes + counters.skipped_bytes
        assert taken == counters.bytes_in - self._pending, "bytes were lost or counted twice"

    @property
    def _pending(self) -> int:
        return self.master.pending

    def _begin(self) -> None:
        timing = Timing(20 * MS, 5 * MS, MS // 2)
        self.master = Master(
            self._wanted, timing, self._counters, over_tcp=self._over_tcp, name="bus", begun_ns=self.now_ns
        )

    def _hear(self, chunk: bytes) -> None:
        self.now_ns += int(self._random.choice([10_000, 200_000, 7 * MS], p=[0.6, 0.38, 0.02]))
        self.found["bytes"] += len(chunk)
        try:
            self.master.heard(chunk, self.now_ns)
        except ValueError:  # the bus closes the connection then
            assert self._over_tcp
            self.found["closed"] += 1
            rows = self.master.rows
            self._begin()
            self.master.rows = rows

    def _message(self, said: bytes) -> Message:
        if self._over_tcp:
            return Message(said[6], said[7:], int.from_bytes(said[:2], "big"))
        return Message(said[0], said[1:-2])

    def _reply(self, asked: Message) -> bytes:
        random = self._random
        kind = str(random.choice(["good", "exception", "other", "damaged", "cut", "noise"], p=[0.7, *[0.06] * 5]))
        self.found[kind] += 1
        size = wire.reply_size(asked.data) - 2
        data = bytes([asked.data[0], size & 0xFF]) + random.bytes(size)
        if kind == "exception":
            data = bytes([asked.data[0] | 0x80, int(random.integers(1, 12))])
        elif kind == "other":
            asked = asked._replace(unit=int(random.integers(256)), number=int(random.integers(1 << 16)))
        message = asked._replace(data=data)
        frame = bytearray(wire.tcp_frame(message) if self._over_tcp else wire.rtu_frame(message))
        if kind == "damaged":
            frame[int(random.integers(len(frame)))] ^= 1 << int(random.integers(8))
        elif kind == "cut":
            del frame[int(random.integers(len(frame))) :]
        elif kind == "noise":
            frame[:0] = random.bytes(int(random.integers(1, 40)))
        return bytes(frame)
