"""Drivers live in viewers of others, read back by their own readers."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import rerun
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader
from websockets.sync.client import connect

from skinware import Namespace
from skinware.conversion.live import FoxgloveSink, RerunSink, Sink, stream
from skinware.sensor_types import PRESSURE
from tests.cli.fake_skin import FakeSkin, publishing
from tests.views.test_scene import a_hand

PROTOCOL, MESSAGE, HEAD = "foxglove.sdk.v1", 1, 13
"""Its web sockets: the protocol, the code of a message, the bytes before its data."""


@contextmanager
def streamed(namespace: Namespace, sink: Sink) -> Iterator[FakeSkin]:
    """A driver of which all pressures are 40, and that is shown."""
    skin, stop = FakeSkin("torso", a_hand()), threading.Event()
    skin.values = np.full(skin.structure.n_sensors, 40)
    thread = threading.Thread(target=stream, args=(namespace, (), sink, 50.0, stop))
    with publishing(skin):
        thread.start()
        try:
            yield skin
        finally:
            stop.set()
            thread.join()


def test_rerun_has_places_values_and_states(namespace: Namespace, tmp_path: Path) -> None:
    recording, seen = rerun.RecordingStream("test"), threading.Event()
    recording.save(tmp_path / "skin.rrd")
    sink = RerunSink(recording)
    show = sink.show

    def shown(*arguments: Any) -> None:
        show(*arguments)
        seen.set()

    sink.show = shown  # type: ignore[method-assign]
    with streamed(namespace, sink) as skin:
        assert seen.wait(60)
    recording.flush()
    recording.disconnect()
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(tmp_path / "skin.rrd").stream():
        if chunk.entity_path == "/skin/torso/pressure":
            batch = chunk.to_record_batch()
            for name in set(batch.schema.names) - {"time", "log_time", "log_tick"}:
                found.setdefault(name, []).extend(batch.column(name).to_pylist())
    structure = skin.structure
    assert structure.geometry is not None
    np.testing.assert_allclose(found["Points3D:positions"][0], structure.geometry.position_m, atol=1e-6)
    values = next(rows for name, rows in found.items() if name.endswith("value"))
    statuses = next(rows for name, rows in found.items() if name.endswith("status"))
    expected = structure.physical(np.full(structure.n_sensors, 40), PRESSURE.name)
    assert all(np.allclose(row, expected) for row in values)
    assert statuses == [[0] * len(expected)] * len(values)
    assert len({tuple(row) for row in found["Points3D:colors"]}) == 1


def test_foxglove_reads_points_and_states(namespace: Namespace) -> None:
    context = foxglove.Context()
    server = foxglove.start_server(name="skinware", port=0, context=context)
    try:
        with streamed(namespace, FoxgloveSink(context)) as skin, _client(server.port) as client:
            channels: dict[str, Any] = {}
            while "/skin/torso/state" not in channels:
                told = json.loads(client.recv(60))
                channels |= {each["topic"]: each for each in told.get("channels", [])}
            ids = dict(enumerate(channels.values()))
            wanted = [{"id": number, "channelId": channel["id"]} for number, channel in ids.items()]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            messages: dict[str, bytes] = {}
            while len(messages) < len(channels):
                data = client.recv(60)
                if isinstance(data, bytes) and data[0] == MESSAGE:
                    messages[ids[int.from_bytes(data[1:5], "little")]["topic"]] = data[HEAD:]
    finally:
        server.stop()
    points = channels["/skin/torso/points/pressure"]
    schema = Schema(1, points["schema"].encode(), points["schemaEncoding"], points["schemaName"])
    decode = DecoderFactory().decoder_for(points["encoding"], schema)
    assert decode is not None
    cloud = decode(messages["/skin/torso/points/pressure"])
    rows = np.frombuffer(bytes(cloud.data), np.uint8).reshape(cloud.width, cloud.point_step)
    at = next(field.offset for field in cloud.fields if field.name == "intensity")
    expected = skin.structure.physical(np.full(skin.structure.n_sensors, 40), PRESSURE.name)
    np.testing.assert_allclose(np.ascontiguousarray(rows[:, at : at + 4]).view("<f4")[:, 0], expected)
    assert json.loads(messages["/skin/torso/state"])["driver"] == "torso"


def _client(port: int) -> Any:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], max_size=None)  # type: ignore[list-item]
