"""What C calls back into Python for: what it cannot decide, and what others listen for."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.samples import Unused
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.layout import Expand
from skinware_drivers.native import structs
from skinware_drivers.polling import Watch
from skinware_drivers.running.path_plan import SharedArrays
from skinware_drivers.running.publisher import Publisher

Rows = npt.NDArray[np.int64]


@dataclass
class Listeners:
    """Functions of the driver's other parts that C calls.

    Attributes:
        hear: gets the new rows of each batch, before anything else, while frames that may be data are expected.
        offer: gets the rows of frames that are of no module and awaited; returns those that no coroutine waited for.
        sort_out: takes what is no data frame out of rows (bus, first, number); returns how many are left.
        lose: gets a bus that went away, and the system's error number.
        heard: frames came on a bus that is watched.
        damaged: gets bytes of a serial line in which there is no frame, at most four times a second.
    """

    hear: Callable[[Rows], None] = lambda _rows: None
    offer: Callable[[Rows], Rows] = lambda rows: rows
    sort_out: Callable[[int, int, int], int] = lambda _bus, _first, n: n
    lose: Callable[[int, int], None] = lambda _bus, _error: None
    heard: Callable[[], None] = lambda: None
    damaged: Callable[[int, bytes], None] = lambda _bus, _chunk: None


class PathHooks:
    """The hooks of one data path.

    Args:
        decoder, publisher, batch: of the path.
        rows, words: the batch and the state of the path as C has them.
        exchange: what changes between two calls.

    Attributes:
        listeners: to be set.
        count_strangers: counts rows of frames that are of no module.
        error: raised by a hook; to be raised again when C has come back.
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
        """What C may call; NULL where there never is anything to do."""
        has_stamps = self._decoder.device_stamps.are_told
        looks = getattr(self._publisher.watch.look, "__func__", None) is not Watch.look
        return structs.Hooks(
            structs.HEAR(self._guarded(self._on_data)),
            structs.HEAR(self._guarded(self._on_times)) if has_stamps else structs.HEAR(),
            structs.OFFER(self._guarded(self._on_offer)),
            structs.KEEP(self._guarded(self._on_keep)),
            structs.EXPAND(self._guarded(self._on_expand)),
            structs.OFFER(self._guarded(self._on_look)) if looks else structs.OFFER(),
            structs.PUBLISHED(self._guarded(self._on_published)),
            structs.SORT_OUT(self._guarded(self._on_unusual)),
            structs.LOSE(self._guarded(self._on_loss)),
            structs.HEAR(self._guarded(lambda: self.listeners.heard())),
            structs.DAMAGED(self._guarded(self._on_damage)),
        )

    def take_from_watch(self) -> None:
        """Hand over what the watch holds against modules now."""
        watch, exchange = self._publisher.watch, self._exchange
        exchange.module_status[:], exchange.module_untouched[:] = watch.module_status, watch.module_untouched
        self._words.sees_all = watch.sees_all

    def _guarded(self, hook: Callable[..., int | None]) -> Callable[..., int]:
        """An exception cannot go through C: it is kept, and raised when C has come back."""

        def call(*arguments: int) -> int:
            if self.error is not None:
                return 0
            self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
            try:
                return hook(*arguments) or 0
            except BaseException as error:  # noqa: BLE001
                self.error = error
                self._words.must_leave = True
                return 0

        return call

    def _on_unusual(self, bus: int, first: int, n: int) -> int:
        self._words.must_leave = True
        return self.listeners.sort_out(bus, first, n)

    def _on_loss(self, bus: int, error: int) -> None:
        self._words.must_leave = True
        self.listeners.lose(bus, error)

    def _on_damage(self, bus: int, at: int, n: int) -> None:
        self.listeners.damaged(bus, ctypes.string_at(at, n))
        self._take_sample_times()

    def _on_data(self) -> None:
        self._words.must_leave = True
        self.listeners.hear(np.arange(max(self._batch.start, self._batch.headroom), self._batch.stop))

    def _on_times(self) -> None:
        batch = self._batch
        new = slice(max(batch.start, batch.headroom), batch.stop)
        entry = _view(self._words.entry, batch.capacity, np.int64)[new]
        kind = _view(self._words.kind, batch.capacity, np.uint8)[new]
        self._decoder.device_stamps.tell(kind, entry, batch.wire["payload"][new], batch.time_ns[new])

    def _on_offer(self, at: int, n: int) -> None:
        left = self.listeners.offer(_view(at, n, np.int64).copy())
        self._words.must_leave = True  # somebody may have what it waited for
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


def _view(address: int, n: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    found: np.dtype[Any] = np.dtype(dtype)
    memory = memoryview((ctypes.c_char * (n * found.itemsize)).from_address(address))
    return np.ndarray(n, found, memory)
