"""Callback threads: reading, writing, pausing, errors, and an end that leaves nothing behind."""

from __future__ import annotations

import threading
from typing import Any

import numpy.typing as npt
import pytest

from skinware import Sample, ServiceReader, ServiceWriter, threads
from skinware.errors import NameInUse, Paused
from skinware.memory.announcement import living_readers
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware_drivers.testing.waiting import wait_until

SMALL = {"values": ("<i8", 4)}


def publish(writer: ServiceWriter, value: int) -> None:
    writer.begin()["values"][:] = value
    writer.commit(now_ns())


@pytest.mark.parametrize(("options", "kind"), [({}, "asap"), ({"rate_hz": 200}, "periodic 200 Hz")])
def test_a_reader_is_called_with_the_newest(options: dict[str, Any], kind: str, namespace: Namespace) -> None:
    seen: list[int] = []
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("x")
        with threads.start_reader(
            reader, lambda frame: seen.append(int(frame.column("values")[0])), **options
        ) as worker:
            wait_until(lambda: seen[-1:] == [1])
            assert worker.active
            publish(writer, 2)
            wait_until(lambda: seen[-1:] == [2])
            wait_until(lambda: [r.kind for r in living_readers(namespace)] == [kind])
        assert not worker.active
        assert list(living_readers(namespace)) == []
        assert seen == sorted(seen)


def test_a_reader_that_wants_every_frame_gets_it() -> None:
    seen: list[int] = []
    with ServiceWriter("x", SMALL, slots=64) as writer:
        publish(writer, 0)
        reader = ServiceReader[Sample]("x")
        with threads.start_reader(reader, lambda frame: seen.append(int(frame.column("values")[0])), in_order=True):
            wait_until(lambda: seen == [0])
            for value in range(1, 50):
                publish(writer, value)
            wait_until(lambda: len(seen) == 50)
        assert seen == list(range(50))


def test_a_paused_reader_is_not_called() -> None:
    seen: list[int] = []
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("x")
        with threads.start_reader(reader, lambda frame: seen.append(int(frame.column("values")[0]))) as worker:
            wait_until(lambda: seen == [1])
            worker.pause()
            assert worker.paused
            assert not worker.active
            for value in range(2, 10):
                publish(writer, value)
            worker.resume()
            publish(writer, 10)
            wait_until(lambda: seen[-1] == 10)
            # at most the frame that was on its way when it was paused, and what was newest when it went on
            assert len(seen) <= 4


def test_another_structure_is_followed() -> None:
    sizes: list[int] = []
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("x")
        with threads.start_reader(reader, lambda frame: sizes.append(len(frame.column("values")))):
            wait_until(lambda: sizes == [4])
            writer.restructure({"values": ("<i8", 9)})
            publish(writer, 2)
            wait_until(lambda: sizes[-1] == 9)


@pytest.mark.parametrize("rate_hz", [200.0, None])
def test_a_writer_is_called_to_fill(rate_hz: float | None) -> None:
    count = 0

    def fill(columns: dict[str, npt.NDArray[Any]]) -> None:
        nonlocal count
        count += 1
        columns["values"][0] = count

    with threads.start_writer(ServiceWriter("x", SMALL), fill, rate_hz=rate_hz, from_last=True) as worker:
        with ServiceReader[Sample]("x") as reader:
            assert reader.request().column("values")[0] >= 1
            assert reader.request().column("values")[0] >= 2
            worker.pause()
            assert (worker.paused, worker.active, reader.paused) == (True, False, True)
            with pytest.raises(Paused):
                reader.request()
            worker.resume()
            before = count
            assert reader.request().column("values")[0] > before
        assert worker.active
        with pytest.raises(NameInUse):
            ServiceWriter("x", SMALL)
    ServiceWriter("x", SMALL).close()  # the name is free again


def test_an_error_ends_a_worker_and_is_told(caplog: pytest.LogCaptureFixture) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("the sensor is on fire")

    worker = threads.start_writer(ServiceWriter("x", SMALL), fail, rate_hz=1000)
    wait_until(lambda: worker.error is not None)
    wait_until(lambda: not worker.active)
    with pytest.raises(RuntimeError, match="the sensor is on fire"):
        worker.stop()
    assert "writer of x ended: RuntimeError: the sensor is on fire" in caplog.text
    ServiceWriter("x", SMALL).close()


def test_a_worker_that_waits_is_stopped() -> None:
    with ServiceWriter("x", SMALL):
        worker = threads.start_reader(ServiceReader[Sample]("x"), lambda _: None)
        stopper = threading.Thread(target=worker.stop)
        stopper.start()
        stopper.join(30)
        assert not stopper.is_alive()
        paused = threads.start_reader(ServiceReader[Sample]("x"), lambda _: None)
        paused.pause()
        paused.stop()
        assert not paused.active
