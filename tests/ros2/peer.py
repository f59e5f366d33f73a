"""A program of the other side, over DDS: ``python -m tests.ros2.peer``; a JSON line for each thing that it sees.

It takes messages as bytes. Its types are Cyclone DDS' own, made of the same definitions.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import signal
import threading
import time
from typing import Any

from cyclonedds._clayer import ddspy_take
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from skinware.ros2 import messages
from skinware.ros2.dds import _type

_ANY = SampleState.Any | ViewState.Any | InstanceState.Any
_POLL_S = 0.005
_SAYING = threading.Lock()
_HEAD = 64
_TYPES = {
    each.name: each
    for each in (
        messages.POINTS,
        messages.IMAGE,
        messages.SKIN_FRAME,
        messages.SENSORS,
        messages.DIAGNOSTICS,
        messages.PARTICIPANT,
    )
}
_RELIABLE = Policy.Reliability.Reliable(max_blocking_time=10**9)


def say(what: str, **more: Any) -> None:
    with _SAYING:  # lines of several threads
        print(json.dumps({"event": what, **more}), flush=True)


def listen(participant: DomainParticipant, topic: str, type_name: str, *, late: bool, only_heads: bool) -> None:
    """Say what comes under a topic."""
    message_type = _TYPES[type_name]
    durability = Policy.Durability.TransientLocal if late else Policy.Durability.Volatile
    reader = DataReader(
        participant,
        Topic(participant, topic, _type(message_type)),
        Qos(_RELIABLE, durability, Policy.History.KeepLast(5)),
    )
    while True:
        taken = ddspy_take(reader._ref, _ANY, 16)
        for data, info in taken if isinstance(taken, list) else []:
            if info.valid_data:
                told = data[:_HEAD] if only_heads else data
                say("message", topic=topic, size=len(data), data=base64.b64encode(told).decode())
        time.sleep(_POLL_S)


def look(participant: DomainParticipant) -> None:
    """Say which endpoints and participants there are, with what they say of themselves."""
    kinds = {"publication": BuiltinTopicDcpsPublication, "participant": BuiltinTopicDcpsParticipant}
    readers = {name: BuiltinDataReader(participant, kind) for name, kind in kinds.items()}
    while True:
        for name, reader in readers.items():
            for each in reader.take(100):
                if getattr(each, "qos", None) is None or each.sample_info.instance_state != InstanceState.Alive:
                    continue
                data = each.qos[Policy.Userdata].data.decode() if Policy.Userdata in each.qos else ""
                told = {"topic": each.topic_name, "type": each.type_name} if name == "publication" else {}
                say(name, key=each.key.hex, data=data, **told)
        time.sleep(_POLL_S)


def call(participant: DomainParticipant, service: str) -> None:
    """Ask a service twice, under two identities; say what is answered."""
    request, answer = (_type(each, True) for each in (messages.TRIGGER.request, messages.TRIGGER.response))
    qos = Qos(_RELIABLE, Policy.History.KeepLast(10))
    reader = DataReader(participant, Topic(participant, f"rr{service}Reply", answer), qos)
    writer = DataWriter(participant, Topic(participant, f"rq{service}Request", request), qos)
    while not (writer.get_matched_subscriptions() and reader.get_matched_publications()):
        time.sleep(_POLL_S)
    for guid, sequence in ((2**63 + 7, 1), (5, 2)):
        writer.write(request(guid=guid, sequence=sequence, structure_needs_at_least_one_member=0))
    while True:
        for each in reader.take(10):
            say("answer", guid=each.guid, sequence=each.sequence, success=each.success, message=each.message)
        time.sleep(_POLL_S)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("domain", type=int)
    parser.add_argument("--listen", nargs=2, action="append", default=[], metavar=("TOPIC", "TYPE"))
    parser.add_argument("--listen-late", nargs=2, action="append", default=[], metavar=("TOPIC", "TYPE"))
    parser.add_argument("--only-heads", action="store_true", help="say the beginnings of messages: short lines")
    parser.add_argument("--look", action="store_true")
    parser.add_argument("--call", action="append", default=[])
    parser.add_argument("--json", action="store_true", help="as our commands have it; it always does")
    options = parser.parse_args()
    participant = DomainParticipant(options.domain)
    threads = [
        *(
            threading.Thread(
                target=listen, args=(participant, *each), kwargs={"late": False, "only_heads": options.only_heads}
            )
            for each in options.listen
        ),
        *(
            threading.Thread(
                target=listen, args=(participant, *each), kwargs={"late": True, "only_heads": options.only_heads}
            )
            for each in options.listen_late
        ),
        *(threading.Thread(target=call, args=(participant, each)) for each in options.call),
        *([threading.Thread(target=look, args=(participant,))] if options.look else []),
    ]
    for thread in threads:
        thread.daemon = True
        thread.start()
    say("ready")
    with contextlib.suppress(KeyboardInterrupt):
        signal.pause()


if __name__ == "__main__":
    main()
