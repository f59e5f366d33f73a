"""Emulated serial devices, byte for byte, in time that the test owns."""

from __future__ import annotations

from skinware_drivers.virtual.hardware import EmulatedHardware

_START_NS = 10**12
_MS = 1_000_000


class Spoken:
    """A conversation with a device.

    Args:
        device: new.
    """

    def __init__(self, device: EmulatedHardware) -> None:
        self._device = device
        self._now_ns = _START_NS
        device.skip(_START_NS)

    def answers(self, sent: bytes, later_ms: int = 1) -> list[bytes]:
        """What the device says within some time, once it has been sent this, one byte at a time."""
        for at in range(len(sent)):
            self._device.receive(0, sent[at : at + 1], self._now_ns)
        self._now_ns += later_ms * _MS
        return [frame.payload for frame in self._device.emit(self._now_ns)]
