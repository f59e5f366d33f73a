"""Names of buses: ``[interface:]channel[?key=value&...]``, parsed once."""

from __future__ import annotations

import os
from typing import NamedTuple
from urllib.parse import parse_qsl

from skinware.errors import ConfigurationError

_PLACING: dict[str, dict[str, str]] = {
    "replay": {"bus": "", "driver": ""},
    "file": {"bus": "", "driver": ""},
    "serial": {"serial_number": "", "vid_pid": ""},
    "udp_multicast": {"port": "43113"},
    "socketcand": {"host": "", "port": ""},
}
"""By interface: the options that determine the bus beside the channel, with their defaults."""
NETWORKS = ("dds", "ros2", "tcp", "udp", "websocket", "yarp")
"""Interfaces of serial devices that are reached over a network."""


class BusPlace(NamedTuple):
    """The parts of a bus name that determine the bus; ``options`` always have the same order."""

    interface: str
    channel: str
    options: tuple[tuple[str, str], ...]


class BusName(NamedTuple):
    """A bus name in its parts.

    ``vcan0`` is ``socketcan:vcan0``; ``virtual`` is an emulated skin in this process. A path, which has a slash in it
    (``/dev/ttyUSB0``, ``./port``), is a serial port; ``tcp://HOST:PORT`` and ``udp://HOST:PORT`` are streams over a
    network; ``yarp://HOST:PORT/NAME`` is a port of a robot that runs YARP; ``dds://DOMAIN`` are topics of DDS, and
    ``ros2://DOMAIN`` those of rmw_zenoh. URLs of pyserial (``rfc2217://host:port``) are serial ports, too.
    ``can+virtual:`` and ``can+serial:`` are the interfaces of python-can whose names are taken.
    """

    interface: str
    channel: str
    options: dict[str, str]

    @classmethod
    def of(cls, text: str) -> BusName:
        """Return the parts of any text, also of one that names no bus; :func:`parse_bus_name` refuses mistakes."""
        address, _, query = text.partition("?")
        interface, colon, channel = address.partition(":")
        if interface in NETWORKS and channel.startswith("//"):
            channel = channel[2:]
        elif "/" in interface or channel.startswith("//"):  # a path, or a URL of pyserial
            interface, channel = "serial", address
        elif not colon:
            interface, channel = (address, "") if address in ("virtual", "pty", "serial") else ("socketcan", address)
        return cls(interface, channel, dict(parse_qsl(query, keep_blank_values=True)))

    @property
    def is_only_asked(self) -> bool:
        """Whether such a bus is silent until the driver connects to a device, or asks it."""
        return self.interface in (*NETWORKS, "modbus")

    @property
    def place(self) -> BusPlace:
        """The place of the bus: two names of one bus have the same place, whatever other options they have.

        Links are followed. Emulated buses differ if any of their options differs. A USB device that is named by its
        serial number or kind has the place that its name says, wherever it is plugged in.
        """
        usual = dict.fromkeys(sorted(self.options), "") if self.interface == "virtual" else {}
        usual = _PLACING.get(self.interface, usual)
        options = tuple((key, self.options.get(key, value)) for key, value in usual.items())
        channel = os.path.realpath(self.channel) if self.channel.startswith("/") else self.channel
        return BusPlace(self.interface, channel, options)


def parse_bus_name(text: str) -> BusName:
    """Return the parts of a bus name.

    Raises:
        ConfigurationError: it is empty, its options are not ``key=value``, or it names neither a connection nor a port
            for Modbus.
    """
    address, _, query = text.partition("?")
    if "=" in address and "/" not in address:
        raise ConfigurationError(f"bus {text!r}: options begin with a question mark, as in virtual?lose=0.1&seed=1")
    if not address:
        raise ConfigurationError("a bus needs a name, such as vcan0, can0, /dev/ttyUSB0 or virtual")
    try:
        parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise ConfigurationError(f"bus {text!r}: write options as ?key=value&key=value") from None
    name = BusName.of(text)
    if name.interface == "modbus":
        channel = name.channel
        is_usb_device = not channel and name.options.keys() & {"serial_number", "vid_pid"}
        is_port = "/" in channel and not channel.startswith("tcp:")
        if not (is_usb_device or is_port or channel.startswith("tcp://")):
            host = channel.removeprefix("tcp:").strip("/") or "HOST"
            raise ConfigurationError(
                f"bus modbus:{channel}: over TCP that is modbus:tcp://{host}, and a serial port modbus:/dev/ttyUSB0, or"
                f" modbus:./{channel or 'port'}"
            )
    return name
