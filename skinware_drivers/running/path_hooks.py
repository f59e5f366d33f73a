"""Functions of Python that C calls, and the arrays for what changes between two calls of C."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.samples import Unused
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Decoder, Updates
from skinware_drivers.layout import Expand
from skinware_drivers.native import structs
from skinware_drivers.polling import Watch
from skinware_drivers.running.publisher import Publisher

Rows = npt.NDArray[np.int64]
_LEAVING = ("hear", "offer", "sort_out", "lose")
"""Hooks after which Python has something to do."""


class SharedArrays:
    """Arrays for what changes between two calls of C.

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
        if self._decoder.device_stamps.times:
            called["tell_times"] = self._on_times
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

    def _on_times(self) -> None:
        batch = self._batch
        new = slice(max(batch.start, batch.headroom), batch.stop)
        module, kind = self.named(new)
        self._decoder.device_stamps.apply(kind, module, batch.wire["payload"][new], batch.time_ns[new])

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
