"""What rosbags knows of the types that are used here; of ours what the files of the message package say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

PACKAGE = Path(__file__).parents[2] / "ros2" / "skinware_msgs"
OURS = ("SkinFrame", "Sensors")
TRIGGER = "std_srvs/srv/Trigger"


def typestore() -> Typestore:
    """All types, and those that make up the service ``std_srvs/srv/Trigger`` with its event."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in OURS:
        text = (PACKAGE / "msg" / f"{name}.msg").read_text()
        store.register(get_types_from_msg(text, f"skinware_msgs/msg/{name}"))
    store.register(
        {
            f"{TRIGGER}_Request": ([], []),
            f"{TRIGGER}_Response": ([], [("success", _plain("bool")), ("message", _plain("string"))]),
            f"{TRIGGER}_Event": (
                [],
                [
                    ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
                    ("request", (Nodetype.SEQUENCE, ((Nodetype.NAME, f"{TRIGGER}_Request"), 1))),
                    ("response", (Nodetype.SEQUENCE, ((Nodetype.NAME, f"{TRIGGER}_Response"), 1))),
                ],
            ),
            TRIGGER: (
                [],
                [
                    ("request_message", (Nodetype.NAME, f"{TRIGGER}_Request")),
                    ("response_message", (Nodetype.NAME, f"{TRIGGER}_Response")),
                    ("event_message", (Nodetype.NAME, f"{TRIGGER}_Event")),
                ],
            ),
        }
    )
    return store


def with_chars_of_ros(store: Typestore) -> Typestore:
    """The same, with ``char`` being ``uint8``, as it is in hashes that ROS makes.

    rosidl_adapter turns ``char`` of a ``.msg`` file into ``uint8`` before the hash is computed
    (ros2/rosidl, rosidl_adapter/rosidl_adapter/msg/__init__.py, MSG_TYPE_TO_IDL).
    """
    chars: Any = (Nodetype.ARRAY, (_plain("uint8"), 16))
    for name in ("service_msgs/msg/ServiceEventInfo", "rmw_dds_common/msg/Gid"):
        constants, fields = store.fielddefs[name]
        fields = [(field, chars if kind == (Nodetype.ARRAY, (_plain("char"), 16)) else kind) for field, kind in fields]
        store.fielddefs[name] = (constants, fields)
    return store


def _plain(name: str) -> Any:
    return (Nodetype.BASE, (name, 0))
