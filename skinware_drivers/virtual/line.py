"""The bus ``virtual``: which one, of those for each kind of wire."""

from __future__ import annotations

from skinware_drivers.bus import Bus, chosen_by
from skinware_drivers.virtual.bus import DEFAULT_EMULATOR, PlacedCanBus, VirtualCanBus
from skinware_drivers.virtual.hardware import PlacedHardware, load_emulator, medium_of


def _class_of(channel: str, _options: object) -> type[Bus]:
    emulator = load_emulator(channel or DEFAULT_EMULATOR)
    if (medium := medium_of(emulator)) in ("serial", "modbus"):
        from skinware_drivers.virtual.emulated_line import VirtualModbusBus, VirtualSerialBus

        return VirtualSerialBus if medium == "serial" else VirtualModbusBus
    has_places = isinstance(emulator, type) and issubclass(emulator, PlacedHardware)
    return PlacedCanBus if has_places else VirtualCanBus


@chosen_by(_class_of)
def virtual_bus(
    channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
) -> Bus:
    """Return the bus ``virtual``: CAN, a serial line or a Modbus line, as the devices need it.

    Raises:
        ConfigurationError: there is no such emulator, or an option is unknown or has a bad value.
    """
    return _class_of(channel, options)(channel, options, payload_size=payload_size, listen_only=listen_only)
