"""Messages are byte by byte what another program makes of their definitions, and the hashes are those of ROS."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader
from skinware.conversion import ros_messages
from skinware.conversion.ros_messages import Cdr
from skinware.conversion.showing import Showing
from skinware.conversion.tables import sensor_names
from skinware.ros2 import messages
from skinware.ros2.messages import DiagnosticLevel, DiagnosticStatus
from skinware.ros2.transport import Distro, MessageType, NodeIdentity
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.recording.test_viewers import placed
from tests.ros2.store import OURS, PACKAGE, typestore, with_chars_of_ros

STORE = typestore()
SECOND_NS = 1_764_000_000_000_000_123


def made(message_type: str, /, **fields: Any) -> Any:
    return STORE.types[message_type](**fields)


def header(time_ns: int, frame: str = "") -> Any:
    stamp = made("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def serialised(message: Any, name: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, name))


@pytest.mark.parametrize("name", OURS)
def test_the_message_package_has_our_definitions(name: str) -> None:
    text = (PACKAGE / "msg" / f"{name}.msg").read_text()
    assert text == ros_messages.TEXTS[f"skinware_msgs/{name}"]
    assert f'"msg/{name}.msg"' in (PACKAGE / "CMakeLists.txt").read_text()


def test_all_of_the_message_package_is_known_here() -> None:
    assert {each.stem for each in PACKAGE.glob("*/*.[ms][sr][gv]")} == set(OURS)


MESSAGE_TYPES = [
    *(
        messages.POINTS,
        messages.IMAGE,
        messages.SKIN_FRAME,
        messages.SENSORS,
        messages.DIAGNOSTICS,
        messages.PARTICIPANT,
    ),
    *(messages.TRIGGER.request, messages.TRIGGER.response),
]


@pytest.mark.parametrize("message_type", MESSAGE_TYPES, ids=lambda each: each.name)
def test_hashes_are_those_of_the_definitions(message_type: MessageType) -> None:
    assert message_type.hash == with_chars_of_ros(typestore()).hash_rihs01(message_type.name)


def test_the_hash_of_a_service_is_the_one_that_ros_has() -> None:
    assert messages.TRIGGER.hash == with_chars_of_ros(typestore()).hash_rihs01("std_srvs/srv/Trigger")


def test_frames_and_sensors() -> None:
    structure = placed(fake_structure(2, 2, dtype="<u2"))
    with FakeSkin("torso", structure) as skin, DriverReader("torso") as reader:
        skin.break_some()
        skin.publish(3)
        frame = reader.read()
    value = np.zeros(structure.n_sensors)
    for each in structure.types:
        value[structure.index(each.name)] = frame.physical(each.name)
    expected = made(
        "skinware_msgs/msg/SkinFrame",
        header=header(SECOND_NS - frame.published_ns + frame.acquired_ns),
        generation=frame.generation,
        sequence=3,
        acquired_ns=frame.acquired_ns,
        published_ns=frame.published_ns,
        value=value,
        status=frame.status,
        module_time_ns=frame.module_time_ns,
    )
    told = ros_messages.skin_frame(frame, SECOND_NS)
    assert told == serialised(expected, "skinware_msgs/msg/SkinFrame")
    assert len(set(frame.status.tolist())) > 1

    types_of = [next(t for t in structure.types if t.id == number) for number in structure.sensor_type.tolist()]
    names = [structure.sensor_name(row) for row in range(structure.n_sensors)]
    assert structure.geometry is not None
    x, y, z = (np.array(each, np.float64) for each in structure.geometry.position_m.T)
    expected = made(
        "skinware_msgs/msg/Sensors",
        header=header(SECOND_NS),
        generation=7,
        uid=structure.sensor_uid,
        name=names,
        type=[each.name for each in types_of],
        unit=[each.unit for each in types_of],
        scale=np.array([each.scale for each in types_of]),
        offset=np.array([each.offset for each in types_of]),
        module=structure.sensor_module.astype(np.uint32),
        frame_id=structure.geometry.frame.tolist(),
        x=x,
        y=y,
        z=z,
    )
    told = ros_messages.sensors(structure, sensor_names(structure), 7, SECOND_NS)
    assert told == serialised(expected, "skinware_msgs/msg/Sensors")


def test_points_and_images() -> None:
    """What another reader makes of the fields is looked at where recordings are converted; here it is the bytes."""
    with FakeSkin("torso", fake_structure(1, 2)) as skin, DriverReader("torso") as reader:
        skin.publish()
        frame = reader.read()
    for structure in (placed(fake_structure(1, 2)), fake_structure(1, 2)):
        showing = Showing("torso", structure)
        pictures = list(showing.pictures(frame, SECOND_NS))
        assert {each.topic: each.schema for each in pictures} == showing.topics
        for each in pictures:
            name = messages.OF_SCHEMAS[each.schema.name].name
            assert serialised(STORE.deserialize_cdr(each.data, name), name) == each.data
        only = sorted(showing.topics)[0]
        assert [each.topic for each in showing.pictures(frame, SECOND_NS, wanted=only.__eq__)] == [only]


def test_ages_of_points_are_those_of_their_modules() -> None:
    structure = placed(fake_structure(1, 2))
    with FakeSkin("torso", structure) as skin, DriverReader("torso") as reader:
        skin.publish()
        columns = skin.writer.begin(from_last=True)
        now_ns = time.monotonic_ns()
        columns["module_time_ns"][:] = now_ns - 2_000_000_000, 0
        skin.writer.commit(now_ns)
        frame = reader.read()
    (points, *_) = Showing("torso", structure).pictures(frame, SECOND_NS)
    message: Any = STORE.deserialize_cdr(points.data, "sensor_msgs/msg/PointCloud2")
    age = next(field for field in message.fields if field.name == "age")
    data = np.asarray(message.data).reshape(-1, message.point_step)
    ages = data[:, age.offset : age.offset + 4].copy().view("<f4")[:, 0]
    of_first = structure.sensor_module[structure.index("pressure")] == 0
    assert structure.geometry is not None
    known = structure.geometry.known[structure.index("pressure")]
    assert (ages[of_first[known]] >= 2).all()
    assert np.isnan(ages[~of_first[known]]).all()


def test_diagnostics() -> None:
    told = [
        messages.DiagnosticStatus(
            messages.DiagnosticLevel.WARN, "skin: arm", "3 of 4 sensors are fresh", "roboskin", {"dropped": "2"}
        ),
        DiagnosticStatus(DiagnosticLevel.OK, "skin: arm: can0", "live", "can0", {}),
    ]
    status = [
        made(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=each.level,
            name=each.name,
            message=each.message,
            hardware_id=each.hardware,
            values=[made("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in each.values.items()],
        )
        for each in told
    ]
    expected = made("diagnostic_msgs/msg/DiagnosticArray", header=header(SECOND_NS), status=status)
    assert messages.diagnostics(told, SECOND_NS) == serialised(expected, "diagnostic_msgs/msg/DiagnosticArray")


@pytest.mark.parametrize("text", ["", "paused", "größer"])
def test_answers_of_a_service(text: str) -> None:
    expected = made("std_srvs/srv/Trigger_Response", success=not text, message=text)
    assert messages.trigger_response(not text, text) == serialised(expected, "std_srvs/srv/Trigger_Response")


@pytest.mark.parametrize("distro", Distro)
def test_what_tells_which_node_has_which_endpoints(distro: Distro) -> None:
    ids = [bytes(range(first, first + 16)) for first in range(4)]
    told = messages.entities(NodeIdentity("skin", "/robot", distro=distro), ids[0], [ids[1]], ids[2:])
    size = 24 if distro is Distro.HUMBLE else 16

    def gid(data: bytes) -> Any:
        return made("rmw_dds_common/msg/Gid", data=np.frombuffer(data.ljust(size, b"\0"), np.uint8))

    node = made(
        "rmw_dds_common/msg/NodeEntitiesInfo",
        node_namespace="/robot",
        node_name="skin",
        reader_gid_seq=[gid(ids[1])],
        writer_gid_seq=[gid(each) for each in ids[2:]],
    )
    expected = made("rmw_dds_common/msg/ParticipantEntitiesInfo", gid=gid(ids[0]), node_entities_info_seq=[node])
    if distro is Distro.HUMBLE:  # rosbags has the type of later releases: the same but for the size of an identity
        cdr = Cdr().numbers("B", *gid(ids[0]).data).numbers("I", 1).text("/robot").text("skin")
        cdr.numbers("I", 1).numbers("B", *gid(ids[1]).data).numbers("I", 2)
        assert told == cdr.numbers("B", *gid(ids[2]).data, *gid(ids[3]).data).done()
    else:
        assert told == serialised(expected, "rmw_dds_common/msg/ParticipantEntitiesInfo")


def test_endpoints_tell_the_hash_of_their_type() -> None:
    assert messages.endpoint_data(messages.IMAGE.hash, Distro.JAZZY) == f"typehash={messages.IMAGE.hash};".encode()
    assert messages.endpoint_data(messages.IMAGE.hash, Distro.HUMBLE) == b""
