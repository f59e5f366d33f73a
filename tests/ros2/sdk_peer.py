"""A node of zenoh-ros2-sdk, another implementation of rmw_zenoh's conventions, in a process of its own.

It reads questions as lines of JSON, and answers each with one. Definitions of messages are files of a folder, so that
it looks for none elsewhere.
"""

from __future__ import annotations

import itertools
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

_DEADLINE_S = 60.0
_TRY_S = 5.0
"""How long to wait for an answer before it is asked again: a service may be listed before it is known itself."""


class SdkPeer:
    """The process, from outside.

    Args:
        port: of the router, on this machine.
        folder: where definitions are put.
        definitions: of messages by name, ``std_msgs/msg/Header``.
    """

    def __init__(self, port: int, folder: Path, definitions: Mapping[str, str]) -> None:
        for name, text in definitions.items():
            path = folder / f"{name}.msg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        alone = {"HOME": str(folder), "GIT_CONFIG_GLOBAL": os.devnull, "GIT_ALLOW_PROTOCOL": "none"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(port), str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **alone},
        )

    def ask(self, **question: object) -> Any:
        """What it answers to a question; its arguments are those of a function of this module."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(question), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@contextmanager
def sdk_peer(port: int, folder: Path, definitions: Mapping[str, str]) -> Iterator[SdkPeer]:
    one = SdkPeer(port, folder, definitions)
    try:
        yield one
    finally:
        one.close()


def _topics(sdk: Any, port: int) -> Any:
    return dict(sdk.get_topic_names_and_types(0, router_port=port))


def _services(sdk: Any, port: int) -> Any:
    return dict(sdk.get_service_names_and_types(0, router_port=port))


def _message(sdk: Any, port: int, topic: str, type_name: str) -> Any:
    """The next message of a topic, and the hash of its type that was computed from its definition."""
    heard: queue.SimpleQueue[Any] = queue.SimpleQueue()
    definition = sdk.get_registry().get_msg_file_path(type_name).read_text()
    sdk.get_registry().load_message_type(type_name)
    subscriber = sdk.ROS2Subscriber(topic, type_name, heard.put, definition, domain_id=0, router_port=port)
    try:
        return {"hash": subscriber.type_hash, "message": _plain(heard.get(timeout=_DEADLINE_S))}
    finally:
        subscriber.close()


def _trigger(sdk: Any, port: int, service: str) -> Any:
    """What a service of type std_srvs/srv/Trigger answers."""
    request, response = "# nothing\n", "bool success\nstring message\n"
    type_hash = sdk.utils.compute_service_type_hash("std_srvs/srv/Trigger", request, response)
    client = sdk.ROS2ServiceClient(
        service,
        "std_srvs/srv/Trigger",
        "uint8 structure_needs_at_least_one_member\n",
        response,
        domain_id=0,
        router_port=port,
        type_hash=type_hash,
        timeout=_TRY_S,
    )
    answers = (client.call(structure_needs_at_least_one_member=0) for _ in range(round(_DEADLINE_S / _TRY_S)))
    answer = next(answer for answer in answers if answer is not None)
    return {"hash": type_hash, "answer": _plain(answer)}


def _publish(sdk: Any, port: int, topic: str, count: int, domain: int) -> Any:
    """Publish, as long as the process lives, arrays of ``count`` numbers that rise by one each 10 ms."""
    type_name = "std_msgs/msg/Float32MultiArray"
    for name in ("std_msgs/msg/MultiArrayDimension", "std_msgs/msg/MultiArrayLayout", type_name):
        sdk.get_registry().load_message_type(name)
    definition = sdk.get_registry().get_msg_file_path(type_name).read_text()
    publisher = sdk.ROS2Publisher(topic, type_name, definition, domain_id=domain, router_port=port)
    layout = sdk.get_message_class("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0)

    def run() -> None:
        for number in itertools.count():
            publisher.publish(layout=layout, data=np.arange(number, number + count, dtype=np.float32))
            time.sleep(0.01)

    threading.Thread(target=run, daemon=True).start()
    return publisher.keyexpr


_ANSWERS: dict[str, Callable[..., Any]] = {
    "publish": _publish,
    "topics": _topics,
    "services": _services,
    "message": _message,
    "trigger": _trigger,
}


def _plain(value: Any) -> Any:
    """A message as JSON has it; arrays as their type and bytes."""
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "bytes": value.tobytes().hex()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if hasattr(value, "__msgtype__"):
        return {name: _plain(each) for name, each in vars(value).items() if not name.startswith("_")}
    return value


def main() -> None:
    import zenoh_ros2_sdk as sdk

    port, folder = int(sys.argv[1]), sys.argv[2]
    sdk.ZenohSession.get_instance("127.0.0.1", port)
    sdk.get_registry(folder)
    for line in sys.stdin:
        question = json.loads(line)
        print(json.dumps(_ANSWERS[question.pop("ask")](sdk, port, **question)), flush=True)


if __name__ == "__main__":
    main()
