"""Cyclone DDS: join a domain, make types of their definitions, write bytes, and wait for samples."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException, GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.qos import Qos
from cyclonedds.util import duration

from skinware.errors import BridgeError, ConfigurationError
from skinware.ros_types import TEXT, Definitions, dds_name

write_bytes: Callable[[int, bytes | bytearray], int] | None
"""Publish a message, encapsulation and all, of whole words, by the reference of a writer; negative: not published."""
try:
    from cyclonedds import _clayer

    write_bytes = _clayer.ddspy_write
except (ImportError, AttributeError):  # it is not public
    write_bytes = None

_NEW = SampleState.NotRead | ViewState.Any | InstanceState.Any
_ADDRESS = re.compile(r"^\d+(\.\d+){3}$|:")
_PLAIN = {"bool": bool, TEXT: str}

_LOOPBACK = (
    "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)
_NETWORK = "<CycloneDDS><Domain id='any'><General><Interfaces>{}</Interfaces></General></Domain></CycloneDDS>"


def join(number: int, interfaces: Sequence[str], qos: Qos | None = None) -> tuple[Domain | None, DomainParticipant]:
    """Join a domain as one participant; return what must be kept for as long, the second to be dropped first.

    Args:
        interfaces: networks to use, by the name or address of an interface of this machine; empty: as
            ``CYCLONEDDS_URI`` says, or loopback alone if that is not set.
        qos: of the participant.

    Raises:
        ConfigurationError: ``interfaces`` are given and ``CYCLONEDDS_URI`` is set.
        BridgeError: the domain cannot be joined; the message says why.
    """
    configuration = _configuration(interfaces)
    domain = None
    try:
        try:
            domain = Domain(number, configuration)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:  # else this process is in it already
                raise
        return domain, DomainParticipant(number, qos)
    except DDSException as error:
        raise BridgeError(
            f"domain {number} of DDS cannot be joined ({reason(error)}); is a network interface up,"
            " and is CYCLONEDDS_URI in order?"
        ) from None


def struct_type(
    definitions: Definitions, type_name: str = "", before: Mapping[str, Any] | None = None
) -> type[IdlStruct]:
    """Return a type for Cyclone DDS, which checks incoming messages by it.

    Args:
        definitions: of a message, as ROS names it; one with one slash in its name is of no type of ROS.
        type_name: one of the types in it; empty: its own.
        before: fields that come first.
    """
    full = type_name or definitions.type_name
    is_of_ros = definitions.type_name.count("/") > 1
    fields: dict[str, Any] = dict(before or {})
    for field in definitions[full]:
        if "/" in field.kind:
            kind = struct_type(definitions, field.kind.replace("/", "/msg/") if is_of_ros else field.kind)
        elif field.longest:
            kind = idl.bounded_str[field.longest]
        else:
            kind = _PLAIN.get(field.kind) or getattr(idl, field.kind)
        if field.most:
            kind = idl.sequence[kind, field.most]
        elif field.length:
            kind = idl.array[kind, field.length]
        elif field.length is not None:
            kind = idl.sequence[kind]
        fields[field.name] = kind
    made: type[IdlStruct] = make_idl_struct(full.rpartition("/")[2], dds_name(full).replace("::", "."), fields)
    return made


def reason(error: DDSException) -> str:
    """Return the meaning of an error in a few words."""
    return str(error).partition("] ")[2].partition(".")[0] or str(error)


def _configuration(interfaces: Sequence[str]) -> str:
    """Return the configuration of Cyclone DDS; only one part of it may name interfaces, since it adds them up."""
    given = os.environ.get("CYCLONEDDS_URI", "")
    if given and interfaces:
        raise ConfigurationError("--interface and CYCLONEDDS_URI both choose networks: give one of them")
    if not interfaces:
        return given or _LOOPBACK
    named = (
        f"<NetworkInterface {'address' if _ADDRESS.search(each) else 'name'}={quoteattr(each)}/>" for each in interfaces
    )
    return _NETWORK.format("".join(named))


class WaitingThread:
    """A thread that calls ``woke`` whenever there is something to read, until it ``is_over``.

    Threads of Cyclone DDS itself would wait for the interpreter.
    """

    def __init__(self, participant: DomainParticipant, woke: Callable[[], None]) -> None:
        self._waitset, self._woken = WaitSet(participant), GuardCondition(participant)
        self._conditions: dict[Any, ReadCondition] = {}
        self._waitset.attach(self._woken)
        self._woke, self.is_over = woke, False
        self._thread = threading.Thread(target=self._run, name="skinware dds", daemon=True)
        self._thread.start()

    def watch(self, reader: Any) -> None:
        self._conditions[reader] = condition = ReadCondition(reader, _NEW)
        self._waitset.attach(condition)

    def forget(self, reader: Any) -> None:
        self._waitset.detach(self._conditions.pop(reader))

    def end(self) -> None:
        self.is_over = True
        self._woken.set(True)

    def close(self) -> None:
        self.end()
        self._thread.join()
        for condition in (*self._conditions.values(), self._woken):
            self._waitset.detach(condition)
        self._conditions.clear()

    def _run(self) -> None:
        while not self.is_over:
            self._waitset.wait(duration(infinite=True))
            self._woke()
