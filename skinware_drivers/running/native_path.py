"""The data path in C for one generation: it decodes a batch and publishes what is due."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from skinware.errors import PlatformError
from skinware.realtime import now_ns
from skinware_drivers import native
from skinware_drivers.bus import Filter, FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch, compile_decoder
from skinware_drivers.running.path_hooks import Listeners, PathHooks
from skinware_drivers.running.path_plan import SKIPPED, compile_publisher
from skinware_drivers.running.publisher import Publisher

_real_now_ns = now_ns


class _Calls(NamedTuple):
    """Functions of ``path.c`` and ``flow.c``."""

    new: Any
    free: Any
    count_strangers: Any
    deadline_ns: Any
    digest: Any
    publish_if_due: Any
    run: Any


@cache
def _calls() -> _Calls:
    library = native.library()
    size = library.quick.skinware_path_size
    size.argtypes, size.restype = [ctypes.c_int64], ctypes.c_int64
    found = tuple(size(number) for number in range(len(structs.SIZES)))
    if found != structs.SIZES:
        raise PlatformError(f"the data path in C has structures of {found} bytes, not {structs.SIZES}")
    quick, waiting = library.quick, library.waiting
    calls = _Calls(
        quick.skinware_path_new,
        quick.skinware_path_free,
        quick.skinware_path_count_strangers,
        quick.skinware_path_deadline_ns,
        waiting.skinware_path_digest,
        waiting.skinware_path_publish_if_due,
        waiting.skinware_flow_run,
    )
    calls.new.restype = ctypes.c_void_p
    for call in (calls.deadline_ns, calls.digest, calls.run):
        call.restype = ctypes.c_int64
    return calls


class NativePath:
    """Decodes and publishes, on the arrays of a decoder and a publisher.

    Args:
        decoder: what frames mean, and what is known of the skin.
        publisher: when snapshots are published, and what they say beside values.
        batch: what buses fill.
    """

    def __init__(self, decoder: Decoder, publisher: Publisher, batch: FrameBatch) -> None:
        self._decoder, self._publisher, self._batch = decoder, publisher, batch
        self._arrays = arrays = structs.Arrays()
        self._plan, self._words, self._rows = structs.Plan(), structs.Words(), compile_batch(batch, arrays)
        compile_decoder(decoder, self._plan, arrays)
        self._exchange = compile_publisher(publisher, self._plan, arrays)
        self._hooks = PathHooks(decoder, publisher, batch, self._rows, self._words, self._exchange)
        self._plan.hooks = self._hooks.table()
        self._words.on_request = publisher.on_request
        self._words.last_published_ns = now_ns()
        self._calls = _calls()
        made = self._calls.new(ctypes.byref(self._plan), ctypes.byref(self._rows), ctypes.byref(self._words))
        if not made:
            raise MemoryError("no memory for the data path of a driver")
        self._path = path = ctypes.c_void_p(made)
        count = self._calls.count_strangers
        self._hooks.count_strangers = lambda rows, n: count(path, ctypes.c_void_p(rows), ctypes.c_int64(n))

    def __del__(self) -> None:
        if hasattr(self, "_path"):
            self._calls.free(self._path)

    @property
    def listeners(self) -> Listeners:
        """What C calls in other parts of the driver."""
        return self._hooks.listeners

    def announce_waits(self, expects_data: bool, awaited: Sequence[Filter]) -> None:
        """Say which frames are waited for, before a call of C.

        Args:
            expects_data: a coroutine waits for a frame that may be data.
            awaited: let the frames through that a coroutine waits for, of those that are of no module.
        """
        self._words.expects_data = expects_data
        conditions = [structs.IdentifierCondition(mask, value) for value, mask in awaited]
        self._awaited = (structs.IdentifierCondition * len(conditions))(*conditions)
        self._plan.n_awaited, self._plan.awaited = len(conditions), ctypes.addressof(self._awaited)

    def empty(self) -> None:
        """Empty the batch, except for the frames that still wait for their partners, which come first."""
        self._batch.clear()
        self._batch.start = self._batch.headroom - self._words.carried

    def digest(self, interrupted: Sequence[int] = ()) -> None:
        """Decode the batch, and publish what is due.

        Args:
            interrupted: buses of which it is known that they have lost frames since the last batch.
        """
        self.interrupt(interrupted)
        self._rows.start, self._rows.stop = self._batch.start, self._batch.stop
        self._enter()
        result = self._calls.digest(self._path)
        self._leave()
        if result < 0:
            raise MemoryError("no memory for the updates of a driver")

    def interrupt(self, buses: Sequence[int]) -> None:
        """Frames were lost on these buses: what waits for partners there is not joined with what comes now."""
        self._exchange.interrupted[list(buses)] = True

    def publish_if_due(self, read_ns: int) -> None:
        """Publish if the time has come, and nothing speaks against it.

        Args:
            read_ns: all that arrived until then was taken, CLOCK_MONOTONIC ns.
        """
        self._words.read_ns = max(self._words.read_ns, read_ns)
        self._enter()
        self._calls.publish_if_due(self._path)
        self._leave()

    def run(self, flow: structs.Flow) -> int:
        """Let frames flow until Python has something to do.

        Returns:
            Why it has: ``flow.c`` has the numbers.
        """
        self._enter()
        result = int(self._calls.run(self._path, ctypes.byref(flow)))
        self._leave()
        return result

    def leave_soon(self) -> None:
        """Have ``run`` come back after its first take."""
        self._words.must_leave = True

    @property
    def deadline_ns(self) -> int:
        """When ``publish_if_due`` has something to do at the latest, CLOCK_MONOTONIC ns."""
        return int(self._calls.deadline_ns(self._path))

    def _enter(self) -> None:
        counts = self._publisher.count_buses()
        self._exchange.skipped_before[:] = counts[:, SKIPPED]
        self._words.fixed_ns = 0 if now_ns is _real_now_ns else now_ns()
        self._words.wanted_ns = self._publisher.wanted_ns
        self._words.ring, self._words.sequence = self._publisher.writer.ring_address, self._publisher.writer.sequence
        self._hooks.take_from_watch()

    def _leave(self) -> None:
        self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
        for bus in np.flatnonzero(self._exchange.skipped).tolist():
            self._publisher.buses.counters[bus].updates_skipped += int(self._exchange.skipped[bus])
        self._exchange.skipped[:] = 0
        if self._words.hastened:
            self._words.hastened = 0
            self._decoder.tell_of_haste()
        error, self._hooks.error = self._hooks.error, None
        if error is not None:
            raise error
