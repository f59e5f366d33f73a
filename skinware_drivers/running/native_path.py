"""The data path in C for one generation: it decodes a batch, publishes snapshots that are due, and calls Python."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import skinware.native
from skinware.realtime import now_ns
from skinware.status import PatchState, Status, Unused
from skinware_drivers import native
from skinware_drivers.bus import Filter, FrameBatch
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.decoding.decoder import Decoder, Updates
from skinware_drivers.layout import Expand
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch, compile_decoder
from skinware_drivers.polling import Watch
from skinware_drivers.running.publisher import Publisher

Rows = npt.NDArray[np.int64]
_LEAVING = ("hear", "offer", "sort_out", "lose")
"""Hooks after which Python has something to do."""


class SharedArrays:
    """Arrays for what changes between two calls of C; the plan has the same names for them.

    Attributes:
        module_status, module_untouched: (n_modules,) uint8, the doubts of the watch about modules.
        skipped, skipped_before: (n_buses,) int64, updates that were skipped in this call, and before it.
        interrupted: (n_buses,) bool, buses that have lost frames since the last batch.
        sample_next_ns: (n_buses, reasons) int64, when the next sample of an unused frame is wanted.
    """

    def __init__(self, watch: Watch, n_buses: int) -> None:
        self.module_status = watch.module_status.copy()  # a watch may replace its own
        self.module_untouched = watch.module_untouched.copy()
        self.skipped, self.skipped_before = np.zeros((2, n_buses), np.int64)
        self.interrupted = np.zeros(n_buses, bool)
        self.sample_next_ns = np.zeros((n_buses, len(Unused) + 1), np.int64)


@dataclass
class Listeners:
    """Functions of the driver's other parts that C calls.

    Attributes:
        hear: called with the new rows of each batch, before anything else, while frames that may be data are expected.
        offer: called with awaited rows that are of no module; returns those that no coroutine waited for.
        sort_out: removes rows that are no data frames (bus, first, number); returns the number that is left.
        lose: called with a bus that went away, and the system's error number.
        heard: called when frames came on a bus that is watched.
    """

    hear: Callable[[Rows], None] = lambda _rows: None
    offer: Callable[[Rows], Rows] = lambda rows: rows
    sort_out: Callable[[int, int, int], int] = lambda _bus, _first, n: n
    lose: Callable[[int, int], None] = lambda _bus, _error: None
    heard: Callable[[], None] = lambda: None


class Named(NamedTuple):
    """The frames of some rows.

    Attributes:
        module: (n,) module of each; from ``n_modules`` on: none.
        kind: (n,) number of its kind; 255: none.
    """

    module: Rows
    kind: npt.NDArray[np.uint8]


class PathHooks:
    """The hooks of one data path.

    Args:
        rows, words: the batch and the state of the path in C.
        exchange: arrays for what changes between two calls.

    Attributes:
        count_strangers: counts rows of frames that are of no module.
        error: raised by a hook; raised again when C has returned.
    """

    def __init__(
        self,
        decoder: Decoder,
        publisher: Publisher,
        batch: FrameBatch,
        rows: structs.Batch,
        words: structs.Words,
        exchange: SharedArrays,
    ) -> None:
        self._decoder, self._publisher, self._batch = decoder, publisher, batch
        self._rows, self._words, self._exchange = rows, words, exchange
        self.listeners = Listeners()
        self.count_strangers: Callable[[int, int], None] = lambda _rows, _n: None
        self.error: BaseException | None = None
        self._update = _update_dtype(decoder)

    def table(self) -> structs.Hooks:
        """Return what C may call; NULL where there never is anything to do."""
        called: dict[str, Callable[..., int | None]] = {
            "hear": self._on_data,
            "offer": self._on_offer,
            "keep": self._on_keep,
            "expand": self._on_expand,
            "published": self._on_published,
            "sort_out": lambda bus, first, n: self.listeners.sort_out(bus, first, n),
            "lose": lambda bus, error: self.listeners.lose(bus, error),
            "heard": lambda: self.listeners.heard(),
            "damaged": self._on_damage,
        }
        if getattr(self._publisher.watch.look, "__func__", None) is not Watch.look:
            called["look"] = self._on_look
        kinds: dict[str, Any] = {field[0]: field[1] for field in structs.Hooks._fields_}
        return structs.Hooks(
            **{name: kinds[name](self._guarded(hook, name in _LEAVING)) for name, hook in called.items()}
        )

    def take_from_watch(self) -> None:
        """Copy the doubts of the watch about modules."""
        watch, exchange = self._publisher.watch, self._exchange
        exchange.module_status[:], exchange.module_untouched[:] = watch.module_status, watch.module_untouched
        self._words.sees_all = watch.sees_all

    def named(self, rows: slice) -> Named:
        """Return what the frames of these rows are, of the batch that was decoded last."""
        capacity = self._batch.capacity
        return Named(
            _view(self._words.entry, capacity, np.int64)[rows].copy(),
            _view(self._words.kind, capacity, np.uint8)[rows].copy(),
        )

    def _guarded(self, hook: Callable[..., int | None], leaves: bool) -> Callable[..., int]:
        """Return a hook that keeps its exception until C has returned: an exception cannot go through C.

        Args:
            leaves: C returns soon, because a coroutine may continue, or a bus may be closed.
        """

        def call(*arguments: int) -> int:
            if self.error is not None:
                return 0
            self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
            try:
                if leaves:
                    self._words.must_leave = True
                return hook(*arguments) or 0
            except BaseException as error:  # noqa: BLE001
                self.error = error
                self._words.must_leave = True
                return 0

        return call

    def _on_damage(self, bus: int, at: int, n: int) -> None:
        self._decoder.samples[bus].note(Unused.REFUSED, 0, ctypes.string_at(at, n))
        self._take_sample_times()

    def _on_data(self) -> None:
        self.listeners.hear(np.arange(max(self._batch.start, self._batch.headroom), self._batch.stop))

    def _on_offer(self, at: int, n: int) -> None:
        left = self.listeners.offer(_view(at, n, np.int64).copy())
        self.count_strangers(left.ctypes.data, len(left))

    def _on_keep(self, why: int, at: int, n: int) -> None:
        decoder = self._decoder
        decoder.keep_samples(Unused(why), self._batch.bus, self._batch.wire, _view(at, n, np.int64))
        self._take_sample_times()

    def _take_sample_times(self) -> None:
        self._exchange.sample_next_ns[:] = [samples.next_ns for samples in self._decoder.samples]

    def _on_expand(self, number: int, updates_at: int, rows_at: int, failed_at: int, n: int) -> None:
        updates, rows = _view(updates_at, n, np.int64), _view(rows_at, n, np.int64)
        kind, columns = self._decoder.compiled.kinds[number], self._decoder.compiled.columns_of(number)
        taken, how = self._batch.wire[rows], kind.frame.values
        if not isinstance(how, Expand):
            return
        values, found, failed = kind.expand(how, taken["payload"], taken["length"])
        _view(failed_at, n, np.uint8)[failed] = True
        records = self._updates(int(updates.max()) + 1)
        records["values"][updates, columns] = values
        sensors = records["sensors"][updates, columns]
        sensors[~found] = self._decoder.tables.structure.n_sensors
        records["sensors"][updates, columns] = sensors

    def _on_look(self, at: int, n: int) -> None:
        numbers = _view(at, n, np.int64)
        records = self._updates(int(numbers.max()) + 1)[numbers]
        whole = records["whole"] != 0
        sensors = records["sensors"].astype(np.int64)
        sensors[~whole] = self._decoder.tables.structure.n_sensors
        parts = records["values"], records["status"], records["oldest_ns"], records["newest_ns"]
        self._publisher.look(Updates(records["module"], records["group"][:, None], whole, sensors, *parts, True))
        self.take_from_watch()

    def _on_published(self, oldest_ns: int) -> None:
        self._publisher.answer(oldest_ns)
        self._words.wanted_ns = self._publisher.wanted_ns

    def _updates(self, n: int) -> npt.NDArray[np.void]:
        return _view(self._words.store, n, self._update)


def _update_dtype(decoder: Decoder) -> np.dtype[np.void]:
    width, values = decoder.compiled.width, decoder.tables.structure.dtype
    sensors_at = ctypes.sizeof(structs.Update)
    values_at = -(-(sensors_at + 4 * width) // 8) * 8
    status_at = values_at + width * values.itemsize
    names = [field[0] for field in structs.Update._fields_]
    fields: dict[str, tuple[Any, int]] = {name: (np.int64, 8 * number) for number, name in enumerate(names)}
    fields |= {
        "sensors": ((np.int32, (width,)), sensors_at),
        "values": ((values, (width,)), values_at),
        "status": ((np.uint8, (width,)), status_at),
    }
    return np.dtype(
        {
            "names": list(fields),
            "formats": [form for form, _ in fields.values()],
            "offsets": [at for _, at in fields.values()],
            "itemsize": -(-(status_at + width) // 8) * 8,
        }
    )


def _view(address: int, n: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    found: np.dtype[Any] = np.dtype(dtype)
    memory = memoryview((ctypes.c_char * (n * found.itemsize)).from_address(address))
    return np.ndarray(n, found, memory)


_real_now_ns = now_ns
_SKIPPED = OWN_BUS_COUNTERS.index("updates_skipped")


@cache
def _library() -> skinware.native.Library:
    library = native.library()
    quick, waiting = library.quick, library.waiting
    quick.skinware_path_new.restype = ctypes.c_void_p
    for call in (quick.skinware_path_deadline_ns, waiting.skinware_path_digest, waiting.skinware_flow_run):
        call.restype = ctypes.c_int64
    return library


class NativePath:
    """Decodes and publishes, on the arrays of a decoder and a publisher."""

    def __init__(self, decoder: Decoder, publisher: Publisher, batch: FrameBatch) -> None:
        self._decoder, self._publisher, self._batch = decoder, publisher, batch
        self._arrays = arrays = structs.Arrays()
        self._plan, self._words, self._rows = structs.Plan(), structs.Words(), compile_batch(batch, arrays)
        compile_decoder(decoder, self._plan, arrays)
        self._exchange = _compile_publisher(publisher, self._plan, arrays)
        self._hooks = PathHooks(decoder, publisher, batch, self._rows, self._words, self._exchange)
        self._plan.hooks = self._hooks.table()
        self._words.on_request = publisher.on_request
        self._words.last_published_ns = now_ns()
        library = _library()
        self._quick, self._waiting = library.quick, library.waiting
        made = self._quick.skinware_path_new(
            ctypes.byref(self._plan), ctypes.byref(self._rows), ctypes.byref(self._words)
        )
        if not made:
            raise MemoryError("no memory for the data path of a driver")
        self._path = path = ctypes.c_void_p(made)
        count = self._quick.skinware_path_count_strangers
        self.listeners, self.named = self._hooks.listeners, self._hooks.named
        self._hooks.count_strangers = lambda rows, n: count(path, ctypes.c_void_p(rows), ctypes.c_int64(n))

    def __del__(self) -> None:
        if hasattr(self, "_path"):
            self._quick.skinware_path_free(self._path)

    def announce_waits(self, expects_data: bool, awaited: Sequence[Filter]) -> None:
        """Set what coroutines wait for, before a call of C: frames that may be data, or awaited ones of no module."""
        self._words.expects_data = expects_data
        if not awaited and not self._plan.n_awaited:
            return
        conditions = [structs.IdentifierCondition(mask, value) for value, mask in awaited]
        self._awaited = (structs.IdentifierCondition * len(conditions))(*conditions)
        self._plan.n_awaited, self._plan.awaited = len(conditions), ctypes.addressof(self._awaited)

    def empty(self) -> None:
        """Empty the batch, except for the frames that still wait for their partners, which come first."""
        self._batch.clear()
        self._batch.start = self._batch.headroom - self._words.carried

    def digest(self, interrupted: Sequence[int] = ()) -> None:
        """Decode the batch, and publish snapshots that are due; some buses have lost frames since the last batch."""
        self.interrupt(interrupted)
        self._rows.start, self._rows.stop = self._batch.start, self._batch.stop
        self._enter()
        result = self._waiting.skinware_path_digest(self._path)
        self._leave()
        if result < 0:
            raise MemoryError("no memory for the updates of a driver")

    def interrupt(self, buses: Sequence[int]) -> None:
        """Never join frames that wait for partners on these buses with later ones: frames were lost between them."""
        for bus in buses:
            self._exchange.interrupted[bus] = True

    def publish_if_due(self, read_ns: int) -> None:
        """Publish a snapshot if it is due; all frames that arrived until ``read_ns`` were taken."""
        self._words.read_ns = max(self._words.read_ns, read_ns)
        self._enter()
        self._waiting.skinware_path_publish_if_due(self._path)
        self._leave()

    def run(self, flow: structs.Flow) -> int:
        """Let frames flow until Python has something to do; return the reason, a number of ``flow.c``."""
        self._enter()
        result = int(self._waiting.skinware_flow_run(self._path, ctypes.byref(flow)))
        self._leave()
        return result

    @property
    def deadline_ns(self) -> int:
        """The latest time of the next call of ``publish_if_due``, CLOCK_MONOTONIC ns."""
        return int(self._quick.skinware_path_deadline_ns(self._path))

    def _enter(self) -> None:
        counts = self._publisher.count_buses()
        self._exchange.skipped_before[:] = counts[:, _SKIPPED]
        self._words.fixed_ns = 0 if now_ns is _real_now_ns else now_ns()
        self._words.wanted_ns = self._publisher.wanted_ns
        self._words.ring, self._words.sequence = self._publisher.writer.ring_address, self._publisher.writer.sequence
        self._hooks.take_from_watch()

    def _leave(self) -> None:
        self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
        if self._exchange.skipped.any():
            for counters, skipped in zip(self._publisher.buses.counters, self._exchange.skipped.tolist(), strict=True):
                counters.updates_skipped += skipped
            self._exchange.skipped[:] = 0
        if self._words.warns:
            self._words.warns = 0
            self._decoder.warn()
        error, self._hooks.error = self._hooks.error, None
        if error is not None:
            raise error


def _compile_publisher(publisher: Publisher, plan: structs.Plan, arrays: structs.Arrays) -> SharedArrays:
    """Fill in the part of a plan that is about publishing; return the arrays that both sides change."""
    patches, buses, pace = publisher.patches, publisher.buses, publisher.pace
    exchange = SharedArrays(publisher.watch, len(buses.counters))
    plan.period_ns, plan.silence_ns, plan.patience_ns = pace.period_ns, pace.silence_ns, pace.patience_ns
    plan.pause_ns, plan.idle_ns = pace.pause_ns, pace.idle_ns
    plan.by_cycle, plan.most_at_once = publisher.by_cycle, publisher.writer.slots
    plan.stale, plan.state_live, plan.state_stale = int(Status.STALE), int(PatchState.LIVE), int(PatchState.STALE)
    plan.burst_pause_ns = arrays.at(patches.pause_ns)
    plan.standing_out_ns, plan.gap_ns = arrays.at(patches.standing_out_ns), arrays.at(patches.gap_ns)
    plan.is_prompt = arrays.at(publisher.state.is_prompt)
    plan.group_heard_ns, plan.age_limit_ns = arrays.at(patches.group_heard_ns), arrays.at(patches.age_limit_ns)
    plan.patch_heard_ns, plan.patch_state = arrays.at(patches.heard_ns), arrays.at(patches.state)
    plan.patch_lives_until_ns = arrays.at(patches.lives_until_ns)
    for name, array in vars(exchange).items():
        setattr(plan, name, arrays.at(array))
    plan.bus_state, plan.bus_reason = arrays.at(buses.state), arrays.at(buses.reason)
    plan.bus_since_ns, plan.bus_load = arrays.at(buses.since_ns), arrays.at(buses.load)
    plan.bus_samples, plan.bus_samples_bytes = arrays.at(buses.samples), buses.samples.nbytes
    plan.latency_ns, plan.data_path = arrays.at(publisher.latency_ns), arrays.at(publisher.data_path)
    plan.bus_data_path = arrays.at(buses.data_path)
    counts = publisher.count_buses()
    plan.counts, plan.n_counts, plan.n_own_counts = arrays.at(counts), counts.shape[1], len(OWN_BUS_COUNTERS)
    plan.skipped_column = _SKIPPED
    plan.bytes_column = OWN_BUS_COUNTERS.index("bytes_in")
    for name in ("dropped", "frames", "errors", "refused"):
        setattr(plan, f"{name}_column", OWN_BUS_COUNTERS.index(name))
    timing = publisher.timing
    plan.timing, plan.timing_before_ns = arrays.at(timing.both), arrays.at(timing.before_ns)
    for name, offset in publisher.writer.column_offsets().items():
        setattr(plan.columns, name, offset)
    return exchange
