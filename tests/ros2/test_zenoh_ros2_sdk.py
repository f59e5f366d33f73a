"""The skin in a graph of rmw_zenoh, as zenoh-ros2-sdk sees it: an implementation that has nothing to do with ours."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from rosbags.typesys import Stores, get_typestore

from skinware import DriverWriter, Structure
from skinware.geometry import Geometry
from skinware.realtime import now_ns
from skinware.ros2 import messages
from skinware.sensor_types import PRESSURE
from skinware_drivers.testing.waiting import wait_until
from tests.commands import Running, running
from tests.ros2.router import Router, router
from tests.ros2.sdk_peer import SdkPeer, sdk_peer

ROOT = Path(__file__).parents[2]
SENSORS = 12
OF_ROS = (
    "builtin_interfaces/msg/Time",
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "diagnostic_msgs/msg/KeyValue",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/PointField",
    "std_msgs/msg/Header",
)
VALUES = np.arange(SENSORS) * 100 + 7


def definitions() -> dict[str, str]:
    """Of the standard messages as rosbags has them, and of ours as the message package has them."""
    store = get_typestore(Stores.ROS2_JAZZY)
    texts = {name: store.generate_msgdef(name, ros_version=2)[0].partition("\n====")[0] for name in OF_ROS}
    for path in (ROOT / "ros2/skinware_msgs/msg").glob("*.msg"):
        texts[f"skinware_msgs/msg/{path.stem}"] = path.read_text()
    return texts


def structure() -> Structure:
    """A grid of three by four sensors, all of whose places are known."""
    made = Structure(
        types=[PRESSURE.measured(unit="counts", minimum=0, maximum=2000)],
        buses=["can0"],
        patch_name=["palm"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=["3x4"],
        sensor_uid=np.arange(SENSORS),
        sensor_type=[PRESSURE.id] * SENSORS,
        sensor_module=[0] * SENSORS,
        dtype="u2",
    )
    places = Geometry.unknown(["pressure"] * SENSORS, made.sensor_uid)
    places.position_m[:] = np.arange(3 * SENSORS).reshape(SENSORS, 3) / 1000
    places.frame[:] = "hand"
    return made.replace(geometry=places)


@contextmanager
def driver(tared: list[bool]) -> Iterator[None]:
    """One that publishes by itself, and can be tared."""
    with DriverWriter("arm", structure(), rate_hz=50, operations={"tare": lambda: None}) as writer:
        requests, ended = writer.request_server(), threading.Event()

        def work() -> None:
            while not ended.is_set():
                columns = writer.begin(from_last=True)
                time_ns = now_ns()
                columns["values"][:] = VALUES
                columns["status"][:] = 0
                columns["module_time_ns"][:] = time_ns
                writer.commit(time_ns)
                for request in requests.take(0.02):
                    tared.append(True)
                    request.reply()

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def bridge(at: Router, *options: str) -> Any:
    return running("skin-bridge", "ros2", "--rmw", "zenoh", "--connect", at.endpoint, *options)


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    return definitions()


def array(told: dict[str, str]) -> npt.NDArray[Any]:
    return np.frombuffer(bytes.fromhex(told["bytes"]), told["dtype"])


def check_points(sdk: SdkPeer) -> None:
    told = sdk.ask(ask="message", topic="/skin/arm/points/pressure", type_name=messages.POINTS.name)
    message = told["message"]
    fields = {field["name"]: field["offset"] for field in message["fields"]}
    rows = array(message["data"]).reshape(SENSORS, message["point_step"])
    intensity = np.ascontiguousarray(rows[:, fields["intensity"] :][:, :4]).view("<f4")[:, 0]
    x = np.ascontiguousarray(rows[:, fields["x"] :][:, :4]).view("<f4")[:, 0]
    assert told["hash"] == messages.POINTS.hash
    assert message["header"]["frame_id"] == "hand"
    assert (message["width"], message["height"], message["row_step"]) == (SENSORS, 1, rows.size)
    assert np.array_equal(intensity, VALUES)
    assert np.array_equal(x, np.float32(np.arange(0, 3 * SENSORS, 3) / 1000))


def check_image(sdk: SdkPeer) -> None:
    told = sdk.ask(ask="message", topic="/skin/arm/image/palm/pressure", type_name=messages.IMAGE.name)
    message = told["message"]
    pixels = array(message["data"]).view("<u2").reshape(message["height"], message["width"])
    assert told["hash"] == messages.IMAGE.hash
    assert (message["encoding"], message["is_bigendian"], message["step"]) == ("mono16", 0, 2 * message["width"])
    assert pixels.shape == (3, 4)
    assert np.array_equal(pixels.ravel(), (VALUES / 2000 * 65534 + 1).astype(np.uint16))


def check_frame(sdk: SdkPeer) -> None:
    told = sdk.ask(ask="message", topic="/skin/arm/frame", type_name=messages.SKIN_FRAME.name)
    message = told["message"]
    assert told["hash"] == messages.SKIN_FRAME.hash
    assert np.array_equal(array(message["value"]), VALUES)
    assert not array(message["status"]).any()
    assert message["generation"] > 0
    assert message["acquired_ns"] <= message["published_ns"]


def check_tare(sdk: SdkPeer, tared: list[bool]) -> None:
    wait_until(lambda: sdk.ask(ask="services") == {"/skin/arm/tare": ["std_srvs/srv/Trigger"]})
    told = sdk.ask(ask="trigger", service="/skin/arm/tare")
    assert told == {"hash": messages.TRIGGER.hash, "answer": {"success": True, "message": ""}}
    assert tared


@pytest.mark.thorough
def test_the_sdk_lists_topics_decodes_them_and_tares(tmp_path: Path, texts: dict[str, str]) -> None:
    tared: list[bool] = []
    with router() as at, driver(tared), bridge(at, "--tare") as ros2, sdk_peer(at.port, tmp_path, texts) as sdk:
        wait_for_live(ros2)
        topics = {
            "/diagnostics": [messages.DIAGNOSTICS.name],
            "/skin/arm/frame": [messages.SKIN_FRAME.name],
            "/skin/arm/image/palm/pressure": [messages.IMAGE.name],
            "/skin/arm/points/pressure": [messages.POINTS.name],
            "/skin/arm/sensors": [messages.SENSORS.name],
        }
        wait_until(lambda: bool(sdk.ask(ask="topics") == topics))
        check_points(sdk)
        check_image(sdk)
        check_frame(sdk)
        diagnostics = sdk.ask(ask="message", topic="/diagnostics", type_name=messages.DIAGNOSTICS.name)
        assert diagnostics["hash"] == messages.DIAGNOSTICS.hash
        assert diagnostics["message"]["status"]
        check_tare(sdk, tared)


def wait_for_live(ros2: Running) -> None:
    ros2.wait_for("status", lambda event: event["drivers"].get("arm", {}).get("state") == "live")


@pytest.mark.thorough
def test_the_router_comes_after_the_bridge_and_is_told_of(tmp_path: Path) -> None:
    at = Router()
    with driver([]), bridge(at) as ros2:
        assert "no zenoh router at" in ros2.wait_for("router")["why"]
        wait_for_live(ros2)
        at.start()
        try:
            assert "is there" in ros2.wait_for("router")["why"]
        finally:
            at.kill()
