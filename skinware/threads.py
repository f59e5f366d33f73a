"""Callbacks in threads of their own, for programs that would rather be called than loop.

::

    def show(frame):
        print(frame.physical("pressure").max())

    with skinware.threads.start_reader(skinware.DriverReader("roboskin"), show, rate_hz=30):
        ...  # do something else

The thread owns what it was given, and closes it at its end. Its callback must not be slow for long: a reader then loses
samples, a writer misses periods; no other program is held up.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Generic, Self, TypeVar

import numpy.typing as npt

from skinware.errors import Closed, Overrun, ServiceTimeout, StructureChanged
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.service import ServiceReader, Writer
from skinware.skin import Skin
from skinware.snapshot import Snapshot

log: logging.Logger = logging.getLogger("skinware.threads")

_REST_AFTER_OVERRUN_S = 0.01

T = TypeVar("T")
F = TypeVar("F", bound=Sample)


class Worker(Generic[T]):
    """A thread that calls a function repeatedly.

    Args:
        name: of the thread.
        owned: what it works on; closed when the thread ends.
        items: what the function is called with.
        function: called in the thread; if it raises, the worker ends (``error``).
    """

    def __init__(
        self,
        name: str,
        owned: ServiceReader[Any] | Writer | Skin,
        items: Callable[[], Iterator[T]],
        function: Callable[[T], object],
    ) -> None:
        self.error: BaseException | None = None
        self._owned = owned
        self._items = items
        self._function = function
        self._running = threading.Event()
        self._running.set()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    @property
    def active(self) -> bool:
        """Whether it works: neither paused, nor stopped, nor ended by an error."""
        return self._thread.is_alive() and not self.paused

    @property
    def paused(self) -> bool:
        """Whether ``pause`` was called last."""
        return not self._running.is_set()

    def pause(self) -> None:
        """Call the function no more until ``resume``."""
        self._running.clear()

    def resume(self) -> None:
        """Go on after ``pause``, with what is newest then."""
        self._running.set()

    def stop(self) -> None:
        """End the thread and wait for it. Idempotent; not from within the function itself.

        Raises:
            BaseException: what the function raised, if that ended it.
        """
        self._owned.stop()
        self._running.set()
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _work(self) -> None:
        try:
            for item in self._items():
                if not self._running.is_set():
                    self._running.wait()
                    continue
                self._function(item)
        except Closed:
            pass  # the usual end
        except BaseException as error:  # noqa: BLE001, whatever it is belongs to the thread that calls stop()
            self.error = error
            log.error("%s ended: %s: %s", self._thread.name, type(error).__name__, str(error))
        finally:
            self._owned.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def start_reader(
    reader: ServiceReader[F],
    function: Callable[[F], object],
    *,
    rate_hz: float | None = None,
    in_order: bool = False,
) -> Worker[F]:
    """Start a thread that calls a function with the samples of a service.

    When the service comes back with another structure, its samples of that structure follow. A sample that the writer
    overwrites too fast for a copy is left out (``reader.statistics.overruns``).

    Args:
        reader: belongs to the thread from now on.
        function: called with each sample, a private copy.
        rate_hz: None: each time the writer publishes; otherwise at this rate with what is newest.
        in_order: every sample instead of the newest.
    """

    def samples() -> Iterator[F]:
        while True:
            try:
                yield from reader.in_order() if in_order else reader.samples(rate_hz)
                return
            except StructureChanged:
                reader.reattach()
            except Overrun:  # the reader has counted it
                time.sleep(_REST_AFTER_OVERRUN_S)

    return Worker(f"reader of {reader.name}", reader, samples, function)


def start_writer(
    writer: Writer,
    function: Callable[[dict[str, npt.NDArray[Any]]], object],
    *,
    rate_hz: float | None = None,
    from_last: bool = False,
) -> Worker[dict[str, npt.NDArray[Any]]]:
    """Start a thread that calls a function to fill each sample of a service.

    Args:
        writer: belongs to the thread from now on.
        function: called with the arrays of the next sample, to be filled in place.
        rate_hz: at this rate; None: whenever a program asks for a sample.
        from_last: the arrays hold the newest sample first.
    """

    def samples() -> Iterator[dict[str, npt.NDArray[Any]]]:
        if rate_hz is None:
            return writer.on_request(from_last=from_last)
        return writer.periodic(rate_hz, from_last=from_last)

    writer.request_server()  # programs may ask from now on
    return _WriterWorker(f"writer of {writer.name}", writer, samples, function)


class _WriterWorker(Worker[dict[str, npt.NDArray[Any]]]):
    """A paused worker pauses its writer, so that readers and requesters notice it.

    The writer itself yields nothing then; a sample that was begun before is filled, and not published.
    """

    _owned: Writer

    @property
    def paused(self) -> bool:
        return self._owned.paused

    def pause(self) -> None:
        self._owned.pause()

    def resume(self) -> None:
        self._owned.resume()


class SkinReplica(Worker[Snapshot]):
    """The whole skin, kept up to date by a thread; any number of other threads can look at it.

    A snapshot never changes: it has one published sample of each driver.

    Args:
        skin: used only by the thread from now on.
        function: called in the thread with each new snapshot.
        rate_hz: None: each time a driver publishes; otherwise at this rate.
    """

    def __init__(
        self,
        skin: Skin | None = None,
        function: Callable[[Snapshot], object] = lambda _: None,
        *,
        rate_hz: float | None = None,
    ) -> None:
        self._snapshot: Snapshot | None = None
        self._news = threading.Condition()
        skin = skin or Skin()

        def keep(snapshot: Snapshot) -> None:
            with self._news:
                self._snapshot = snapshot
                self._news.notify_all()
            function(snapshot)

        super().__init__("replica of the skin", skin, lambda: skin.samples(rate_hz), keep)

    @property
    def snapshot(self) -> Snapshot | None:
        """The newest snapshot, None before the first."""
        return self._snapshot

    def wait(self, *, newer_than: Snapshot | None = None, timeout_s: float = 5.0) -> Snapshot:
        """Return the next snapshot.

        Args:
            newer_than: another than this one. Default: any.
            timeout_s: longest wait.

        Raises:
            ServiceTimeout: none came in time.
            Closed: the replica was stopped, or its function failed; ``snapshot`` is what it saw last.
        """
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        with self._news:
            while True:
                if self.error is not None or not self._thread.is_alive():
                    raise Closed(f"the replica of the skin has ended{f' ({self.error})' if self.error else ''}")
                if self._snapshot is not None and self._snapshot is not newer_than:
                    return self._snapshot
                remaining_ns = deadline_ns - now_ns()
                if remaining_ns <= 0:
                    raise ServiceTimeout(
                        f"nothing new on the skin within {timeout_s:g} s (skin-info shows the running drivers)"
                    )
                self._news.wait(min(remaining_ns, WAIT_SLICE_NS) / NS_PER_S)
