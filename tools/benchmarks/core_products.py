"""What ``core`` compares, each in its best documented form, behind one small interface.

A message is HEAD words (phase, sequence, stamp) and the values. ``publish`` copies the values into it, stamps it, hands
it over and wakes the readers. ``receive`` copies the next message, in order, into an array of the reader's own. All
products may keep as many messages for a slow reader (``DEPTH``).
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

import skinware
from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import ServiceTimeout
from skinware.realtime import now_ns

HEAD = 3
DEPTH = 8
_HEAD_BYTES = 8 * HEAD
_MAX_READERS = 16
_WAIT_MS = 5000  # longer than it takes to start all readers

Values = npt.NDArray[np.uint16]
Message = tuple[int, int, int, Values]
"""Phase, sequence, stamp (CLOCK_MONOTONIC ns) and the reader's own copy of the values."""


class Publisher(Protocol):
    """The writer's end of a product."""

    def publish(self, phase: int, sequence: int, values: Values) -> None:
        """Send one message and wake everybody."""

    def close(self) -> None:
        """Take everything back."""


class Subscriber(Protocol):
    """A reader's end of a product."""

    def messages(self) -> Iterator[Message]:
        """All messages in order; ends when none came for a while."""

    def close(self) -> None:
        """Take everything back."""


class Product(Protocol):
    """How to open both ends of a topic for a number of sensors."""

    name: str

    def publisher(self, topic: str, n_sensors: int) -> Publisher:
        """The writer's end; it is opened first."""

    def subscriber(self, topic: str, n_sensors: int, /) -> Subscriber:
        """A reader's end."""


class Skinware:
    """Ours: a service of one column, its sequence, time stamp and flags; readers copy each frame in order."""

    name = "skinware"

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace

    def publisher(self, topic: str, n_sensors: int) -> Publisher:
        return _SkinwarePublisher(topic, n_sensors, self._namespace)

    def subscriber(self, topic: str, _n_sensors: int) -> Subscriber:
        return _SkinwareSubscriber(topic, self._namespace)


class SkinwareInC(Skinware):
    """Ours, read by a program of ``skinware.h``."""

    name = "c"

    def __init__(self, namespace: Namespace) -> None:
        super().__init__(namespace)
        self._folder = tempfile.TemporaryDirectory()
        program = Path(self._folder.name) / "core_reader"
        source = Path(__file__).with_name("core_reader.c")
        subprocess.run(["cc", "-O2", f"-I{skinware.get_include()}", "-o", program, source], check=True)
        self._command = [str(program), namespace.name]

    def reader_command(self, topic: str) -> list[str]:
        """The program, and what to tell it."""
        return [*self._command, topic]


class _SkinwarePublisher:
    def __init__(self, topic: str, n_sensors: int, namespace: Namespace) -> None:
        self._writer = ServiceWriter(topic, {"values": ("<u2", n_sensors)}, namespace=namespace, slots=DEPTH)

    def publish(self, phase: int, sequence: int, values: Values) -> None:
        self._writer.begin()["values"][:] = values
        committed = self._writer.commit(now_ns(), flags=phase)
        assert committed == sequence

    def close(self) -> None:
        self._writer.close()


class _SkinwareSubscriber:
    def __init__(self, topic: str, namespace: Namespace) -> None:
        self._reader: ServiceReader[Sample] = ServiceReader(topic, namespace=namespace, timeout_s=10)

    def messages(self) -> Iterator[Message]:
        try:
            for frame in self._reader.in_order(timeout_s=_WAIT_MS / 1000):
                yield frame.flags, frame.sequence, frame.acquired_ns, frame.column("values")
        except ServiceTimeout:
            return

    def close(self) -> None:
        self._reader.close()


class Iceoryx2:
    """iceoryx2: samples loaned and filled in shared memory, and its event service for the wake-up."""

    name = "iceoryx2"

    def __init__(self) -> None:
        import iceoryx2

        self._library: Any = iceoryx2
        self._library.set_log_level(self._library.LogLevel.Error)

    def publisher(self, topic: str, n_sensors: int) -> Publisher:
        return _IceoryxPublisher(self._library, topic, n_sensors)

    def subscriber(self, topic: str, n_sensors: int) -> Subscriber:
        return _IceoryxSubscriber(self._library, topic, n_sensors)


class _IceoryxEnd:
    """A node with both services of a topic: samples and events."""

    def __init__(self, library: Any, topic: str, n_sensors: int) -> None:
        self.size = _HEAD_BYTES + 2 * n_sensors
        self.array_type = ctypes.c_uint8 * self.size
        silent = library.SignalHandlingMode.Disabled
        self.node = library.NodeBuilder.new().signal_handling_mode(silent).create(library.ServiceType.Ipc)
        name = library.ServiceName.new(topic)
        self.samples = (
            self.node.service_builder(name)
            .publish_subscribe(library.Slice[ctypes.c_uint8])
            .payload_alignment(library.Alignment.new(8))
            .subscriber_max_buffer_size(DEPTH)
            .max_subscribers(_MAX_READERS)
            .max_nodes(_MAX_READERS + 2)
            .open_or_create()
        )
        self.events = (
            self.node.service_builder(name)
            .event()
            .max_listeners(_MAX_READERS)
            .max_nodes(_MAX_READERS + 2)
            .open_or_create()
        )

    def memory(self, sample: Any) -> npt.NDArray[np.uint8]:
        """The bytes of a sample, in place."""
        return np.frombuffer(memoryview(self.array_type.from_address(sample.payload_ptr)), np.uint8)


class _IceoryxPublisher:
    def __init__(self, library: Any, topic: str, n_sensors: int) -> None:
        self._end = _IceoryxEnd(library, topic, n_sensors)
        self._publisher = self._end.samples.publisher_builder().initial_max_slice_len(self._end.size).create()
        self._notifier = self._end.events.notifier_builder().create()

    def publish(self, phase: int, sequence: int, values: Values) -> None:
        sample = self._publisher.loan_slice_uninit(self._end.size)
        memory = self._end.memory(sample)
        memory[_HEAD_BYTES:].view(np.uint16)[:] = values
        memory[:_HEAD_BYTES].view(np.int64)[:] = phase, sequence, now_ns()
        sample.assume_init().send()
        self._notifier.notify()

    def close(self) -> None:
        self._publisher.delete()
        self._notifier.delete()


class _IceoryxSubscriber:
    def __init__(self, library: Any, topic: str, n_sensors: int) -> None:
        self._end = _IceoryxEnd(library, topic, n_sensors)
        self._subscriber = self._end.samples.subscriber_builder().create()
        self._listener = self._end.events.listener_builder().create()
        self._wait = library.Duration.from_millis(_WAIT_MS)

    def messages(self) -> Iterator[Message]:
        while self._listener.timed_wait(self._wait):
            while (sample := self._subscriber.receive()) is not None:
                copy = self._end.memory(sample).copy()
                sample.delete()
                phase, sequence, stamp_ns = copy[:_HEAD_BYTES].view(np.int64).tolist()
                yield phase, sequence, stamp_ns, copy[_HEAD_BYTES:].view(np.uint16)

    def close(self) -> None:
        self._subscriber.delete()
        self._listener.delete()


class Zenoh:
    """zenoh: peers on the loopback, no scouting, no batching; payloads in its shared memory or in the stream."""

    def __init__(self, port: int, *, shared_memory: bool) -> None:
        import zenoh

        self._library: Any = zenoh
        self.name = "zenoh" if shared_memory else "zenoh-tcp"
        self._endpoint = f"tcp/127.0.0.1:{port}"
        self._shared_memory = shared_memory

    def publisher(self, topic: str, n_sensors: int) -> Publisher:
        return _ZenohPublisher(self._library, self._session("listen"), topic, n_sensors, self._shared_memory)

    def subscriber(self, topic: str, _n_sensors: int) -> Subscriber:
        return _ZenohSubscriber(self._library, self._session("connect"), topic)

    def _session(self, role: str) -> Any:
        config = self._library.Config()
        for key, value in (
            ("mode", "peer"),
            ("scouting/multicast/enabled", False),
            ("scouting/gossip/enabled", False),
            ("listen/endpoints", []),
            (f"{role}/endpoints", [self._endpoint]),
            ("transport/shared_memory/enabled", self._shared_memory),
        ):
            config.insert_json5(key, json.dumps(value))
        return self._library.open(config)


class _ZenohPublisher:
    def __init__(self, library: Any, session: Any, topic: str, n_sensors: int, shared_memory: bool) -> None:
        self._session = session
        self._publisher = session.declare_publisher(topic, express=True)
        self._staged = bytearray(_HEAD_BYTES + 2 * n_sensors)
        self._head = np.frombuffer(self._staged, np.int64, HEAD)
        self._values = np.frombuffer(self._staged, np.uint16, n_sensors, _HEAD_BYTES)
        self._provider = None
        if shared_memory:
            self._provider = library.shm.ShmProvider.default_backend(8 * DEPTH * len(self._staged) + (1 << 20))
            self._policy = library.shm.BlockOn(library.shm.GarbageCollect())

    def publish(self, phase: int, sequence: int, values: Values) -> None:
        self._values[:] = values
        if self._provider is None:
            self._head[:] = phase, sequence, now_ns()
            self._publisher.put(bytes(self._staged))
            return
        buffer = self._provider.alloc(len(self._staged), policy=self._policy)
        self._head[:] = phase, sequence, now_ns()
        buffer[: len(self._staged)] = self._staged
        self._publisher.put(buffer)

    def close(self) -> None:
        self._session.close()


class _ZenohSubscriber:
    def __init__(self, library: Any, session: Any, topic: str) -> None:
        self._session = session
        self._subscriber = session.declare_subscriber(topic, library.handlers.RingChannel(DEPTH))

    def messages(self) -> Iterator[Message]:
        while True:
            data = self._subscriber.recv().payload.to_bytes()
            phase, sequence, stamp_ns = np.frombuffer(data, np.int64, HEAD).tolist()
            yield phase, sequence, stamp_ns, np.frombuffer(data, np.uint16, offset=_HEAD_BYTES)

    def close(self) -> None:
        self._session.close()


def products(names: list[str], namespace: Namespace, port: int) -> list[Product]:
    """The products of these names, in this order.

    Raises:
        ImportError: a library of the extra ``bench`` is not installed.
    """
    makers: dict[str, Callable[[], Product]] = {
        "skinware": lambda: Skinware(namespace),
        "c": lambda: SkinwareInC(namespace),
        "iceoryx2": Iceoryx2,
        "zenoh": lambda: Zenoh(port, shared_memory=True),
        "zenoh-tcp": lambda: Zenoh(port, shared_memory=False),
    }
    return [makers[name]() for name in names]


NAMES = ("skinware", "c", "iceoryx2", "zenoh", "zenoh-tcp")
