"""What viewers and ROS 2 read of a recording, by their own readers."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import skinware.recording
from skinware import Structure
from skinware.conversion import Selection, convert, ros_messages
from skinware.conversion.showing import RATE_HZ, Viewers
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.recording.files import Files, recover
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.recording.made import START_NS, MadeTable, made_recording
from tests.recording.rig import recording, two_drivers_and_a_service

ROS = get_typestore(Stores.ROS2_HUMBLE)


def decoded_messages(path: Path, topics: list[str] | None = None) -> list[tuple[str, Any]]:
    """(topic, message) of all messages of ROS 2 in a file, decoded by what the file says of them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = reader.iter_messages(topics)
        wanted = {channel.topic for _, channel, _ in messages if channel.message_encoding == "cdr"}
        return [(channel.topic, each) for _, channel, _, each in reader.iter_decoded_messages(sorted(wanted))]


def placed(structure: Structure, frames: tuple[str, ...] = ("chest",)) -> Structure:
    """Sensors at random places, in some coordinate frames in turn; the last one is nowhere."""
    n = structure.n_sensors
    geometry = Geometry.unknown([structure.types[0].name] * n, structure.sensor_uid)
    geometry.position_m[:-1] = np.random.default_rng(1).random((n - 1, 3))
    geometry.frame[:-1] = [frames[number % len(frames)] for number in range(n - 1)]
    return structure.replace(geometry=geometry)


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, MadeTable, Structure]:
    """A second of a driver with places."""
    structure = placed(fake_structure(2, 2, dtype="<u2"))
    file = tmp_path / "walk.mcap"
    return file, made_recording(file, structure, 100), structure


def points_of(message: Any) -> npt.NDArray[np.void]:
    """The points of a PointCloud2, by what it says of itself."""
    codes = {7: "<f4", 2: "u1"}
    fields = [(field.name, codes[field.datatype], field.offset) for field in message.fields]
    names, formats, offsets = zip(*fields, strict=True)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})
    assert message.row_step == message.point_step * message.width
    return np.frombuffer(bytes(message.data), dtype)


def check_points(message: Any, table: MadeTable, structure: Structure, type_name: str) -> None:
    """A point cloud has the values of the frame that was published at its time."""
    row = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - START_NS) // 10_000_000
    assert structure.geometry is not None
    index = np.arange(structure.n_sensors)[structure.index(type_name)]
    known = structure.geometry.known[index]
    points = points_of(message)
    physical = structure.physical(table.columns["values"][row], type_name)
    assert np.array_equal(points["intensity"], physical[known])
    assert np.array_equal(points["status"], table.columns["status"][row][index][known])
    for axis, letter in enumerate("xyz"):
        assert np.array_equal(points[letter], structure.geometry.position_m[index[known], axis].astype("<f4"))
    assert (message.header.frame_id, message.height, message.is_bigendian) == ("chest", 1, False)


def test_rosbags_reads_a_bag_and_its_values_are_equal(
    recorded: tuple[Path, MadeTable, Structure], tmp_path: Path
) -> None:
    file, table, structure = recorded
    converted = convert(file, tmp_path / "bag", "ros2")
    assert converted.notes == [f"{tmp_path}/bag: counters, histograms and events are left out: ros2 does not hold them"]
    for place in (tmp_path / "bag", tmp_path / "bag" / "walk_0.mcap"):
        by_topic = defaultdict(list)
        with AnyReader([place]) as bag:
            assert bag.message_count == sum(connection.msgcount for connection in bag.connections)
            for connection, time_ns, data in bag.messages():
                by_topic[connection.topic].append((time_ns, bag.deserialize(data, connection.msgtype)))
        assert set(by_topic) == {
            "/skin/torso/frame",
            "/skin/torso/sensors",
            "/skin/torso/state",
            "/skin/torso/points/pressure",
            "/skin/torso/points/temperature",
        }
        frames: list[tuple[int, Any]] = by_topic["/skin/torso/frame"]
        assert len(frames) == 100
        for row, (time_ns, frame) in enumerate(frames):
            assert time_ns == START_NS + row * 10_000_000
            assert (frame.sequence, frame.generation) == (row + 1, table.origin.generation)
            for name in ("pressure", "temperature"):
                physical = structure.physical(table.columns["values"][row], name)
                assert np.array_equal(frame.value[structure.index(name)], physical)
            assert np.array_equal(frame.status, table.columns["status"][row])
            assert np.array_equal(frame.module_time_ns, table.columns["module_time_ns"][row])
        sensors: Any = by_topic["/skin/torso/sensors"][0][1]
        assert len(by_topic["/skin/torso/sensors"]) == 1
        assert np.array_equal(sensors.uid, structure.sensor_uid)
        assert sensors.name == [structure.sensor_name(position) for position in range(structure.n_sensors)]
        raw = np.rint((frames[7][1].value - sensors.offset) / sensors.scale)
        assert np.array_equal(raw, table.columns["values"][7])
        for name in ("pressure", "temperature"):
            clouds: list[tuple[int, Any]] = by_topic[f"/skin/torso/points/{name}"]
            assert len(clouds) in (RATE_HZ, RATE_HZ + 1)
            for _, cloud in clouds:
                check_points(cloud, table, structure, name)
        state: Any = by_topic["/skin/torso/state"][-1][1]
        assert json.loads(state.data)["driver"] == "torso"


def test_the_reader_of_mcap_for_ros2_reads_the_same(
    recorded: tuple[Path, MadeTable, Structure], tmp_path: Path
) -> None:
    file, table, structure = recorded
    convert(file, tmp_path / "bag", "ros2")
    convert(file, tmp_path / "x.mcap", "foxglove")
    with (tmp_path / "bag" / "walk_0.mcap").open("rb") as stream:
        assert make_reader(stream).get_header().profile == "ros2"
    for path in (tmp_path / "bag" / "walk_0.mcap", tmp_path / "x.mcap"):
        clouds = [each for _, each in decoded_messages(path, ["/skin/torso/points/pressure"])]
        assert len(clouds) in (RATE_HZ, RATE_HZ + 1)
        for cloud in clouds:
            check_points(cloud, table, structure, "pressure")


def test_definitions_are_those_of_ros() -> None:
    for schema in (ros_messages.POINTS, ros_messages.IMAGE, ros_messages.TEXT):
        theirs, _ = ROS.generate_msgdef(schema.name, ros_version=2)
        assert fields_of(schema.data.decode()) == fields_of(theirs)


def fields_of(text: str) -> dict[str, list[str]]:
    """The fields of a message and of its parts, without comments."""
    parts = [part.strip() for part in text.split("=" * 80)]
    return {
        part.splitlines()[0] if number else "": sorted(
            " ".join(line.split("#")[0].replace("=", " = ").split())
            for line in part.splitlines()[bool(number) :]
            if line.split("#")[0].strip()
        )
        for number, part in enumerate(parts)
    }


def test_without_places_there_are_images_only_and_it_says_so(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    structure = fake_structure(2, 2)
    table = made_recording(file, structure, 50)
    converted = convert(file, None, "foxglove")
    assert converted.path == tmp_path / "walk.foxglove.mcap"
    assert converted.notes == [f"{converted.path}: torso: no place of a sensor is known: images only, no points"]
    topics = ["/skin/torso/image/board_7/pressure", "/skin/torso/image/board_8/pressure"]
    found = defaultdict(list)
    for topic, each in decoded_messages(converted.path):
        found[topic].append(each)
    assert set(topics) < set(found)
    assert not [topic for topic in found if "points" in topic]
    for patch, topic in enumerate(topics):
        images = found[topic]
        assert len(images) in (15, 16)
        for image in images:
            row = (image.header.stamp.sec * 10**9 + image.header.stamp.nanosec - START_NS) // 10_000_000
            assert (image.encoding, image.step, image.is_bigendian) == ("mono16", 2 * image.width, 0)
            pixels = np.frombuffer(bytes(image.data), "<u2").reshape(image.height, image.width)
            index = np.intersect1d(
                np.arange(structure.n_sensors)[structure.index("pressure")], sensors_of(structure, patch)
            )
            physical = 255.0 - table.columns["values"][row][index].astype(float)
            good = table.columns["status"][row][index] == 0
            expected = np.floor(physical[good].astype("<f4") / np.float32(255) * 65534 + 1)
            assert set(expected.astype(int).tolist()) | {0} == set(pixels.ravel().tolist()) | {0}


def sensors_of(structure: Structure, patch: int) -> npt.NDArray[np.int64]:
    """Positions of the sensors of a patch."""
    return np.arange(structure.n_sensors)[structure.patch_index(patch)]


def test_a_grid_is_an_image_with_a_pixel_for_each_sensor(tmp_path: Path) -> None:
    structure = fake_structure(1, 1, dtype="<f4").replace(module_kind=["2x5"])
    types = [each.measured(unit=each.unit, scale=each.scale) for each in structure.types]  # of no range
    table = made_recording(tmp_path / "x.mcap", placed(structure.replace(types=types)), 10)
    convert(tmp_path / "x.mcap", tmp_path / "shown.mcap", "foxglove")
    topic = "/skin/torso/image/board_7/pressure"
    image = decoded_messages(tmp_path / "shown.mcap", [topic])[0][1]
    assert (image.height, image.width, image.encoding, image.step) == (2, 5, "32FC1", 20)
    pixels = np.frombuffer(bytes(image.data), "<f4")
    good = table.columns["status"][0][:10] == 0
    assert np.array_equal(pixels, np.where(good, -table.columns["values"][0][:10], 0))


def test_coordinate_frames_are_clouds_of_their_own(tmp_path: Path) -> None:
    structure = placed(fake_structure(1, 2), ("chest", "left arm"))
    made_recording(tmp_path / "x.mcap", structure, 10, name="my-skin")
    convert(tmp_path / "x.mcap", tmp_path / "shown.mcap", "foxglove")
    frames = {
        topic: each.header.frame_id
        for topic, each in decoded_messages(tmp_path / "shown.mcap")
        if "/points/pressure" in topic
    }
    assert frames == {
        "/skin/my_skin/points/pressure/chest": "chest",
        "/skin/my_skin/points/pressure/left_arm": "left arm",
    }


def test_events_and_states_are_json(tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    two_drivers_and_a_service(file)
    converted = convert(file, tmp_path / "shown.mcap", "foxglove")
    assert f"{converted.path}: pose is left out: it has no sensors" in converted.notes
    found = defaultdict(list)
    with converted.path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            if channel.message_encoding == "json":
                found[channel.topic].append(json.loads(message.data))
    assert [event["event"] for event in found["/skin/events"]][:3] == ["found"] * 3
    state = found["/skin/torso/state"][-1]
    assert [patch["name"] for patch in state["patches"]] == ["board 7", "board 8", "board 9", "board 10"]
    assert [patch["state"] for patch in state["patches"]] == ["live", "live", "live", "stale"]
    assert state["patches"][-1]["fresh"] == 0
    assert state["buses"] == [{"name": "can0", "state": "live", "load": 0.0}]
    with pytest.raises(ConfigurationError, match="no driver is in it, and nothing else can be shown"):
        convert(file, tmp_path / "pose.mcap", "foxglove", Selection(["pose"]))


def test_they_are_recorded_live_too_beside_all_frames(tmp_path: Path) -> None:
    file = tmp_path / "live.mcap"
    with (
        FakeSkin("torso", placed(fake_structure(1, 2))) as skin,
        recording(file, Files(file), renderer=Viewers().messages) as recorder,
    ):
        for _ in range(60):
            skin.publish()
            time.sleep(0.005)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 60)
    recover(file, tmp_path / "whole.mcap")
    for path in (file, tmp_path / "whole.mcap"):
        with skinware.recording.open(path) as opened:
            assert (opened.services, opened.problems) == (("torso",), [])
            series = opened["torso"].read()
            values = series.physical("pressure")
        shown = decoded_messages(path, ["/skin/torso/points/pressure"])
        assert 1 <= len(shown) <= RATE_HZ * (series.time_s[-1] - series.time_s[0]) + 2
        for _, each in shown:
            points = points_of(each)
            assert (points["intensity"] == values).all(axis=1).any()
