"""Emulated CANopen skin patches, made with the ``canopen`` package from an EDS.

The package's ``LocalNode`` answers SDO requests and holds the object dictionary. Its threads are not used: NMT,
heartbeat, event timers and SYNC (CiA 301) run here, in the time of the emulation.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Collection, Sequence
from importlib import resources
from typing import Annotated, Any

from msgspec import Meta

from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, Places, on_a_grid
from skinware_drivers.virtual.hardware import Event

_HEARTBEAT = "heartbeat"
_BOOT_UP, _STOPPED, _OPERATIONAL, _PRE_OPERATIONAL = 0, 4, 5, 127
_STATES = {1: _OPERATIONAL, 2: _STOPPED, 128: _PRE_OPERATIONAL}
_RESETS = (129, 130)
_TYPE_EVENT = 254
_REAL32 = 8


class EmulatedCanopenOptions(EmulatorOptions, frozen=True):
    nodes: Annotated[tuple[int, ...], Meta(description="node ids of the patches, 1-127")] = (5, 6)
    eds: Annotated[str, Meta(description="EDS file; default: the example's")] = ""


class EmulatedCanopen(Emulator[EmulatedCanopenOptions]):
    """Patches on one bus.

    Values: those of the TPDOs, in the order of their mapping, but for objects with a unit of their own (a temperature,
    say), which keep their default.
    """

    full_scale = 4095
    rest = 100
    swing = 3500
    numbered_by = "nodes"

    def __init__(self, options: EmulatedCanopenOptions, **more: Any) -> None:
        super().__init__(options, **more)
        functions = range(0x080, 0x780, 0x80)  # of the predefined connection set
        own = {function + node for function in functions for node in (0, *options.nodes)}
        self.identifiers: Collection[int] = {0x000} | own

    def places(self) -> Places:
        mapped = [variable for _, entries in _tpdos(_make_node(self.options.eds, 1, None)) for variable, _ in entries]
        count = sum(_is_felt(variable) for variable in mapped)
        return on_a_grid(count, max(1, round(count**0.5)))

    def boot(self, device: Device, now_ns: int) -> None:
        """Send the boot-up message and be pre-operational, or with ``streaming`` operational."""
        device.memory["node"] = _make_node(self.options.eds, device.number, _Ports(self, device))
        self.reply(device, (0x700 + device.number, bytes([_BOOT_UP])), now_ns)
        device.memory["state"] = _PRE_OPERATIONAL
        if self.options.streaming:
            self._go_to(device, _OPERATIONAL, now_ns)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier == 0x000 and len(payload) == 2 and payload[1] in (0, device.number):
            if payload[0] in _RESETS:
                self.lose_power_for_a_moment(device, now_ns)
            elif payload[0] in _STATES:
                self._go_to(device, _STATES[payload[0]], now_ns)
            return payload[0] in (*_RESETS, *_STATES)
        if identifier == 0x080 and device.memory["state"] == _OPERATIONAL:
            self.burst(device, now_ns)
            return True
        if identifier == 0x600 + device.number and len(payload) == 8 and device.memory["state"] != _STOPPED:
            device.memory["now_ns"] = now_ns
            device.memory["node"].sdo.on_request(identifier, bytearray(payload), 0.0)
            return True
        return False

    def on_timer(self, device: Device, name: str, time_ns: int) -> None:
        if name == _HEARTBEAT:
            self.reply(device, (0x700 + device.number, bytes([device.memory["state"]])), time_ns)
        else:
            self.burst(device, time_ns)

    def kinds(self) -> Sequence[str]:
        """Name the TPDOs, the answers of SDO and the heartbeats of each node."""
        beside = [self.kind_of(first + number, b"") for number in self.numbers for first in (0x580, 0x700)]
        return [*super().kinds(), *beside]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        found, rest = [], list(values)
        for identifier, entries in _tpdos(device.memory["node"]):
            bits, length = 0, 0
            for variable, width in entries:
                value = rest.pop(0) if _is_felt(variable) else variable.default
                if variable.data_type == _REAL32:
                    value = int.from_bytes(struct.pack("<f", value), "little")
                bits |= (value & ((1 << width) - 1)) << length
                length += width
            found.append((identifier, bits.to_bytes(-(-length // 8), "little")))
        return found

    def report_error(self, number: int, code: int, now_ns: int) -> None:
        """Send an EMCY: an error, or with code 0 its end."""
        now_ns, device = self.run_to(now_ns), self.device(number)
        if device.alive and now_ns >= device.ready_ns:
            self.reply(device, (0x080 + device.number, struct.pack("<HB5x", code, int(code != 0))), now_ns)
            self.log.append(Event("error_reported", now_ns, board=device.number, code=code))

    def _go_to(self, device: Device, state: int, now_ns: int) -> None:
        device.memory["state"] = state
        self.stop(device)
        node = device.memory["node"]
        kind, timer_ms = _number(node, 0x1800, 2), _number(node, 0x1800, 5)
        if state == _OPERATIONAL and kind >= _TYPE_EVENT and timer_ms:
            self.start(device, now_ns, timer_ms / 1e3)


class _Ports:
    """The network of a ``LocalNode``: it takes the node's answers and starts its heartbeat."""

    def __init__(self, emulator: EmulatedCanopen, device: Device) -> None:
        self._emulator, self._device = emulator, device

    def subscribe(self, can_id: int, callback: object) -> None:
        """Do nothing: the emulator calls the node itself."""

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self._emulator.reply(self._device, (can_id, bytes(data)), self._device.memory["now_ns"])

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> _Ports:  # noqa: ARG002
        period_ns = round(period * 1e9)
        self._device.every(_HEARTBEAT, period_ns, self._device.memory["now_ns"] + period_ns)
        return self

    def stop(self) -> None:
        self._device.stop(_HEARTBEAT)


def _make_node(eds: str, number: int, ports: _Ports | None) -> Any:
    import canopen

    logging.getLogger("canopen").setLevel(logging.WARNING)  # it logs every transfer
    source = eds or str(resources.files("skinware_drivers") / "eds" / "skin_patch.eds")
    node = canopen.LocalNode(number, source)
    if ports is not None:
        node.associate_network(ports)  # type: ignore[arg-type]
    return node


def _number(node: Any, index: int, subindex: int) -> int:
    return int.from_bytes(node.get_data(index, subindex), "little")


def _tpdos(node: Any) -> list[tuple[int, list[tuple[Any, int]]]]:
    found = []
    for mapping in (index for index in node.object_dictionary if 0x1A00 <= index < 0x1C00):
        entries = []
        for subindex in range(1, _number(node, mapping, 0) + 1):
            mapped = _number(node, mapping, subindex)
            variable = node.object_dictionary.get_variable(mapped >> 16, mapped >> 8 & 0xFF)
            entries.append((variable, mapped & 0xFF))
        found.append((_number(node, mapping - 0x200, 1), entries))
    return found


def _is_felt(variable: Any) -> bool:
    return not variable.unit
