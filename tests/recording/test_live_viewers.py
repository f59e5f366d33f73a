"""Drivers live in viewers of others, read back by their own readers."""

from __future__ import annotations

import contextlib
import json
import socket
from pathlib import Path
from threading import Event
from typing import Any, cast

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from skinware import Namespace
from skinware.conversion.live import Sink, stream
from skinware.errors import NamespaceError
from skinware.sensor_types import PRESSURE
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, publishing
from tests.commands import PATIENCE_S, refused, running
from tests.streams.peers import LOCAL, free_port
from tests.views.test_scene import a_hand

PROTOCOL, MESSAGE, HEAD = Subprotocol("foxglove.sdk.v1"), 1, 13
"""Its web sockets: the protocol, the code of a message, the bytes before its data."""


def torso() -> FakeSkin:
    """A driver of which all pressures are 40."""
    skin = FakeSkin("torso", a_hand())
    skin.values = np.full(skin.structure.n_sensors, 40)
    return skin


def test_rerun_has_places_values_and_states(tmp_path: Path) -> None:
    file = tmp_path / "skin.rrd"
    with publishing(torso()) as skin, running("skin-bridge", "rerun", "-o", str(file)) as bridge:
        bridge.wait_for("ready")
        wait_until(lambda: file.exists() and file.stat().st_size > 30_000)  # some snapshots
        bridge.stop()
    found = _columns(file)
    structure = skin.structure
    assert structure.geometry is not None
    np.testing.assert_allclose(found["Points3D:positions"][0], structure.geometry.position_m, atol=1e-6)
    values = next(rows for name, rows in found.items() if name.endswith("value"))
    statuses = next(rows for name, rows in found.items() if name.endswith("status"))
    expected = structure.physical(np.full(structure.n_sensors, 40), PRESSURE.name)
    assert all(np.allclose(row, expected) for row in values)
    assert statuses == [[0] * len(expected)] * len(values)
    assert len({tuple(row) for row in found["Points3D:colors"]}) == 1


@pytest.mark.parametrize("is_there", [False, True], ids=["no viewer", "silent"])
def test_rerun_ends_without_a_viewer(is_there: bool) -> None:
    with publishing(torso()), contextlib.ExitStack() as stack:
        port = free_port()
        if is_there:
            stack.enter_context(socket.create_server((LOCAL, port)))
        url = f"rerun+http://{LOCAL}:{port}/proxy"
        bridge = stack.enter_context(running("skin-bridge", "rerun", "--connect", url))
        bridge.wait_for("ready")
        bridge.stop()
    assert (f"skin-bridge: no viewer at {url} yet (Connection refused): start one" in bridge.errors) is not is_there


def test_a_namespace_that_may_not_be_read_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refusals = iter([NamespaceError("the folder may not be read")] * 2)
    stop = Event()

    def refuse(_: Namespace) -> dict[str, int]:
        for error in refusals:
            raise error
        stop.set()
        return {}

    monkeypatch.setattr(Namespace, "service_inodes", refuse)
    stream(Namespace(), (), cast(Sink, None), 1000.0, stop)
    assert caplog.messages == ["the folder may not be read", "the drivers can be read now"]


def _columns(file: Path) -> dict[str, list[Any]]:
    """The rows of each column of the driver's pressure."""
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(file).stream():
        if chunk.entity_path == "/skin/torso/pressure":
            batch = chunk.to_record_batch()
            for name in set(batch.schema.names) - {"time", "log_time", "log_tick"}:
                found.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_foxglove_reads_points_and_states() -> None:
    channels: dict[str, Any] = {}
    messages: dict[str, bytes] = {}
    with publishing(torso()) as skin, running("skin-bridge", "foxglove", "--listen", "tcp/127.0.0.1:0") as bridge:
        with connect(bridge.wait_for("ready")["to"], subprotocols=[PROTOCOL], max_size=None) as client:
            while "/skin/torso/state" not in channels:
                told = json.loads(client.recv(PATIENCE_S))
                channels |= {each["topic"]: each for each in told.get("channels", [])}
            topics = dict(enumerate(channels))
            wanted = [{"id": number, "channelId": channels[topic]["id"]} for number, topic in topics.items()]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            while len(messages) < len(channels):
                data = client.recv(PATIENCE_S)
                if isinstance(data, bytes) and data[0] == MESSAGE:
                    messages[topics[int.from_bytes(data[1:5], "little")]] = data[HEAD:]
        bridge.stop()
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


@pytest.mark.parametrize("listen", ["127.0.0.1:8765", "tcp/127.0.0.1", "tcp/127.0.0.1:65536", "tls/127.0.0.1:1"])
def test_foxglove_says_where_it_can_listen(listen: str) -> None:
    done = refused("skin-bridge", "foxglove", "--listen", listen)
    assert (done.returncode, f"{listen!r}" in done.stderr and "give tcp/HOST:PORT" in done.stderr) == (2, True)


def test_foxglove_ends_beside_clients_that_say_nothing_or_leave_without_a_word() -> None:
    with publishing(torso()), running("skin-bridge", "foxglove", "--listen", "tcp/127.0.0.1:0") as bridge:
        url = bridge.wait_for("ready")["to"]
        place = (LOCAL, int(url.rpartition(":")[2]))
        with socket.create_connection(place), connect(url, subprotocols=[PROTOCOL], max_size=None) as client:
            socket.create_connection(place).close()  # a scanner of ports
            client.recv(PATIENCE_S)
            client.socket.shutdown(socket.SHUT_RDWR)
            bridge.stop()
    assert bridge.errors == ""
