"""The data path in C for one generation: the decoder's and the publisher's arrays, and what Python adds to it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import PlatformError
from skinware.native import Library
from skinware.realtime import now_ns
from skinware.samples import Unused
from skinware.status import PatchState, Status
from skinware_drivers import native
from skinware_drivers.bus import Filter, FrameBatch
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.layout import Expand
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch, compile_decoder
from skinware_drivers.polling import Watch
from skinware_drivers.running.publisher import Publisher

Rows = npt.NDArray[np.int64]

_real_now_ns = now_ns


class NativePath:
    """Does what the decoder and the publisher do, on their arrays.

    Args:
        decoder: what frames mean, and what is known of the skin.
        publisher: when snapshots are published, and what they say beside values.
        batch: what buses fill.

    Attributes:
        expects_data: somebody waits for a frame that may be data; to be set before each call.
        hear: shown the new rows of each batch, before anything else, while that is so.
        awaited: lets the frames through that somebody waits for, of those that are of no module; likewise.
        offer: shown the rows of these; returns those that nobody waited for.
        sort_out: takes what is no data frame out of rows (bus, first, number); returns how many are left.
        lose: told which bus went away, and the system's error number.
        heard: told that frames came on a bus that is watched.
        damaged: shown bytes of a serial line in which there is no frame, at most four times a second.
    """

    def __init__(self, decoder: Decoder, publisher: Publisher, batch: FrameBatch) -> None:
        self._decoder, self._publisher, self._batch = decoder, publisher, batch
        self.expects_data = False
        self.awaited: Sequence[Filter] = ()
        self.hear: Callable[[Rows], None] = lambda _rows: None
        self.offer: Callable[[Rows], Rows] = lambda rows: rows
        self.sort_out: Callable[[int, int, int], int] = lambda _bus, _first, n: n
        self.lose: Callable[[int, int], None] = lambda _bus, _error: None
        self.heard: Callable[[], None] = lambda: None
        self.damaged: Callable[[int, bytes], None] = lambda _bus, _chunk: None
        self._error: BaseException | None = None
        self._arrays = arrays = structs.Arrays()
        self._plan, self._words, self._rows = structs.Plan(), structs.Words(), compile_batch(batch, arrays)
        compile_decoder(decoder, self._plan, arrays)
        self._compile_publisher(publisher, arrays)
        self._plan.hooks = self._make_hooks()
        library = native.library()
        self._load(library)
        self._words.last_published_ns = now_ns()
        made = library.quick.skinware_path_new(
            ctypes.byref(self._plan), ctypes.byref(self._rows), ctypes.byref(self._words)
        )
        if not made:
            raise MemoryError("no memory for the data path of a driver")
        self._path = ctypes.c_void_p(made)
        self._update = self._update_dtype()

    def __del__(self) -> None:
        if hasattr(self, "_path"):
            self._free(self._path)

    # -- what Python calls ----------------------------------------------------------------------------------------

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
        result = self._digest(self._path)
        self._leave()
        if result < 0:
            raise MemoryError("no memory for the updates of a driver")

    def interrupt(self, buses: Sequence[int]) -> None:
        """Frames were lost on these buses: what waits for partners there is not joined with what comes now."""
        self._interrupted[list(buses)] = True

    def publish_if_due(self, read_ns: int) -> None:
        """Publish if the time has come, and nothing speaks against it.

        Args:
            read_ns: all that arrived until then was taken, CLOCK_MONOTONIC ns.
        """
        self._words.read_ns = max(self._words.read_ns, read_ns)
        self._enter()
        self._publish_if_due(self._path)
        self._leave()

    def run(self, flow: structs.Flow) -> int:
        """Let frames flow until Python has something to do.

        Returns:
            Why it has: ``flow.c`` has the numbers.
        """
        self._enter()
        result = int(self._run(self._path, ctypes.byref(flow)))
        self._leave()
        return result

    def leave_soon(self) -> None:
        """Have ``run`` come back after its first take."""
        self._words.must_leave = True

    @property
    def deadline_ns(self) -> int:
        """When ``publish_if_due`` has something to do at the latest, CLOCK_MONOTONIC ns."""
        return int(self._deadline_ns(self._path))

    def _enter(self) -> None:
        counts = self._publisher.count_buses()
        self._skipped_before[:] = counts[:, self._skipped_column]
        self._words.fixed_ns = 0 if now_ns is _real_now_ns else now_ns()
        self._words.wanted_ns = self._publisher.wanted_ns
        self._words.ring, self._words.sequence = self._publisher.writer.ring_address, self._publisher.writer.sequence
        self._words.expects_data = self.expects_data
        self._take_from_watch()
        conditions = [structs.IdentifierCondition(mask, value) for value, mask in self.awaited]
        self._awaited = (structs.IdentifierCondition * len(conditions))(*conditions)
        self._plan.n_awaited, self._plan.awaited = len(conditions), ctypes.addressof(self._awaited)

    def _leave(self) -> None:
        self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
        for bus in np.flatnonzero(self._skipped).tolist():
            self._publisher.buses.counters[bus].updates_skipped += int(self._skipped[bus])
        self._skipped[:] = 0
        if self._words.hastened:
            self._words.hastened = 0
            self._decoder.tell_of_haste()
        error, self._error = self._error, None
        if error is not None:
            raise error

    # -- making it ------------------------------------------------------------------------------------------------

    def _load(self, library: Library) -> None:
        size = library.quick.skinware_path_size
        size.argtypes, size.restype = [ctypes.c_int64], ctypes.c_int64
        found = tuple(size(number) for number in range(len(structs.SIZES)))
        if found != structs.SIZES:
            raise PlatformError(f"the data path in C has structures of {found} bytes, not {structs.SIZES}")
        library.quick.skinware_path_new.restype = ctypes.c_void_p
        self._free = library.quick.skinware_path_free
        self._count_strangers = library.quick.skinware_path_count_strangers
        self._deadline_ns = library.quick.skinware_path_deadline_ns
        self._deadline_ns.restype = ctypes.c_int64
        self._digest = library.waiting.skinware_path_digest
        self._digest.restype = ctypes.c_int64
        self._publish_if_due = library.waiting.skinware_path_publish_if_due
        self._run = library.waiting.skinware_flow_run
        self._run.restype = ctypes.c_int64

    def _compile_publisher(self, publisher: Publisher, arrays: structs.Arrays) -> None:
        plan, pauses, patches, buses = self._plan, publisher.pauses, publisher.patches, publisher.buses
        n_buses = len(buses.counters)
        pace = publisher.pace
        plan.period_ns, plan.silence_ns, plan.patience_ns = pace.period_ns, pace.silence_ns, pace.patience_ns
        plan.pause_ns, plan.idle_ns = pace.pause_ns, pace.idle_ns
        plan.by_cycle, plan.most_at_once = publisher.by_cycle, publisher.writer.slots
        plan.stale = int(Status.STALE)
        plan.state_live, plan.state_stale = int(PatchState.LIVE), int(PatchState.STALE)
        plan.burst_pause_ns = arrays.at(pauses.pause_ns)
        plan.standing_out_ns, plan.gap_ns = arrays.at(pauses.standing_out_ns), arrays.at(pauses.gap_ns)
        plan.is_prompt = arrays.at(self._decoder.state.is_prompt)
        plan.group_heard_ns, plan.age_limit_ns = arrays.at(patches.group_heard_ns), arrays.at(patches.age_limit_ns)
        plan.patch_heard_ns, plan.patch_state = arrays.at(patches.heard_ns), arrays.at(patches.state)
        plan.patch_lives_until_ns = arrays.at(patches.lives_until_ns)
        self._module_status = publisher.watch.module_status.copy()  # a watch may replace its own
        self._module_untouched = publisher.watch.module_untouched.copy()
        plan.module_status = arrays.at(self._module_status)
        plan.module_untouched = arrays.at(self._module_untouched)
        plan.bus_state, plan.bus_reason = arrays.at(buses.state), arrays.at(buses.reason)
        plan.bus_since_ns, plan.bus_load = arrays.at(buses.since_ns), arrays.at(buses.load)
        plan.bus_samples, plan.bus_samples_bytes = arrays.at(buses.samples), buses.samples.nbytes
        plan.latency_ns, plan.data_path = arrays.at(publisher.latency_ns), arrays.at(publisher.data_path)
        plan.bus_data_path = arrays.at(buses.data_path)
        self._skipped_column = OWN_BUS_COUNTERS.index("updates_skipped")
        counts = publisher.count_buses()
        plan.counts, plan.n_counts, plan.n_own_counts = arrays.at(counts), counts.shape[1], len(OWN_BUS_COUNTERS)
        plan.skipped_column = self._skipped_column
        for name in ("lost", "frames", "errors", "refused"):
            setattr(plan, f"{name}_column", OWN_BUS_COUNTERS.index(name))
        plan.bytes_column = OWN_BUS_COUNTERS.index("bytes_in")
        self._skipped, self._skipped_before = np.zeros((2, n_buses), np.int64)
        plan.skipped, plan.skipped_before = arrays.at(self._skipped), arrays.at(self._skipped_before)
        self._interrupted = np.zeros(n_buses, bool)
        plan.interrupted = arrays.at(self._interrupted)
        self._sample_next_ns = np.zeros((n_buses, len(Unused) + 1), np.int64)
        plan.sample_next_ns = arrays.at(self._sample_next_ns)
        timing = publisher.timing
        plan.timing, plan.timing_before_ns = arrays.at(timing.both), arrays.at(timing.before_ns)
        for name, offset in publisher.writer.column_offsets().items():
            setattr(plan.columns, name, offset)
        self._words.on_request = publisher.on_request

    def _update_dtype(self) -> np.dtype[np.void]:
        width, values = self._decoder.width, self._decoder.tables.structure.dtype
        sensors_at = structs.UPDATE.itemsize
        values_at = -(-(sensors_at + 4 * width) // 8) * 8
        status_at = values_at + width * values.itemsize
        fields: dict[str, tuple[Any, int]] = {
            name: (np.int64, structs.UPDATE.fields[name][1])  # type: ignore[index]
            for name in structs.UPDATE.names or ()
        }
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

    # -- what C calls ---------------------------------------------------------------------------------------------

    def _make_hooks(self) -> structs.Hooks:
        """What C may call; NULL where there never is anything to do."""
        tells_times = self._decoder.device_stamps.are_told
        looks = getattr(self._publisher.watch.look, "__func__", None) is not Watch.look
        return structs.Hooks(
            structs.HEAR(self._guarded(self._on_data)),
            structs.HEAR(self._guarded(self._on_times)) if tells_times else structs.HEAR(),
            structs.OFFER(self._guarded(self._on_offer)),
            structs.KEEP(self._guarded(self._on_keep)),
            structs.EXPAND(self._guarded(self._on_expand)),
            structs.OFFER(self._guarded(self._on_look)) if looks else structs.OFFER(),
            structs.PUBLISHED(self._guarded(self._on_published)),
            structs.SORT_OUT(self._guarded(self._on_unusual)),
            structs.LOSE(self._guarded(self._on_loss)),
            structs.HEAR(self._guarded(lambda: self.heard())),
            structs.DAMAGED(self._guarded(self._on_damage)),
        )

    def _guarded(self, hook: Callable[..., int | None]) -> Callable[..., int]:
        """What a hook raises cannot go through C: it is raised when C has come back."""

        def call(*arguments: int) -> int:
            if self._error is not None:
                return 0
            self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
            try:
                return hook(*arguments) or 0
            except BaseException as error:  # noqa: BLE001
                self._error = error
                self._words.must_leave = True
                return 0

        return call

    def _on_unusual(self, bus: int, first: int, n: int) -> int:
        self._words.must_leave = True
        return self.sort_out(bus, first, n)

    def _on_loss(self, bus: int, error: int) -> None:
        self._words.must_leave = True
        self.lose(bus, error)

    def _on_damage(self, bus: int, at: int, n: int) -> None:
        self.damaged(bus, ctypes.string_at(at, n))
        self._take_sample_times()

    def _on_data(self) -> None:
        self._words.must_leave = True
        self.hear(np.arange(max(self._batch.start, self._batch.headroom), self._batch.stop))

    def _on_times(self) -> None:
        batch = self._batch
        new = slice(max(batch.start, batch.headroom), batch.stop)
        entry = _view(self._words.entry, batch.capacity, np.int64)[new]
        kind = _view(self._words.kind, batch.capacity, np.uint8)[new]
        self._decoder.device_stamps.tell(kind, entry, batch.wire["payload"][new], batch.time_ns[new])

    def _on_offer(self, at: int, n: int) -> None:
        left = self.offer(_view(at, n, np.int64).copy())
        self._words.must_leave = True  # somebody may have what it waited for
        self._count_strangers(self._path, ctypes.c_void_p(left.ctypes.data), ctypes.c_int64(len(left)))

    def _on_keep(self, why: int, at: int, n: int) -> None:
        decoder = self._decoder
        decoder.keep_samples(Unused(why), self._batch.bus, self._batch.wire, _view(at, n, np.int64))
        self._take_sample_times()

    def _take_sample_times(self) -> None:
        self._sample_next_ns[:] = [samples.next_ns for samples in self._decoder.samples]

    def _on_expand(self, number: int, updates_at: int, rows_at: int, failed_at: int, n: int) -> None:
        updates, rows = _view(updates_at, n, np.int64), _view(rows_at, n, np.int64)
        kind, columns = self._decoder.kinds[number], self._decoder.columns_of(number)
        taken, how = self._batch.wire[rows], kind.frame.values
        if not isinstance(how, Expand):
            return
        values, found, failed = kind.expand(how, taken["payload"], taken["length"])
        _view(failed_at, n, np.uint8)[failed] = True
        records = self._updates(int(updates.max()) + 1)
        records["values"][updates, columns] = values
        sensors = records["sensors"][updates, columns]
        sensors[~found] = self._plan.n_sensors
        records["sensors"][updates, columns] = sensors

    def _on_look(self, at: int, n: int) -> None:
        numbers = _view(at, n, np.int64)
        records = self._updates(int(numbers.max()) + 1)[numbers]
        whole = records["whole"] != 0
        sensors = records["sensors"].astype(np.int64)
        sensors[~whole] = self._plan.n_sensors
        parts = records["values"], records["status"], records["oldest_ns"], records["newest_ns"]
        self._publisher.look(Updates(records["module"], records["group"][:, None], whole, sensors, *parts, True))
        self._take_from_watch()

    def _take_from_watch(self) -> None:
        watch = self._publisher.watch
        self._module_status[:], self._module_untouched[:] = watch.module_status, watch.module_untouched
        self._words.sees_all = watch.sees_all

    def _on_published(self, oldest_ns: int) -> None:
        self._publisher.answer(oldest_ns)
        self._words.wanted_ns = self._publisher.wanted_ns

    def _updates(self, n: int) -> npt.NDArray[np.void]:
        return _view(self._words.store, n, self._update)


def _view(address: int, n: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    found: np.dtype[Any] = np.dtype(dtype)
    memory = memoryview((ctypes.c_char * (n * found.itemsize)).from_address(address))
    return np.ndarray(n, found, memory)
