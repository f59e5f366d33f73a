"""Names of buses, ``[interface:]channel[?key=value&...]``: taken apart, and which bus they mean."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple
from urllib.parse import parse_qsl

from skinware.errors import ConfigurationError

_PLACING: dict[str, dict[str, str]] = {
    "replay": {"bus": "", "driver": ""},
    "serial": {"serial_number": "", "vid_pid": ""},
    "udp_multicast": {"port": "43113"},
    "socketcand": {"host": "", "port": ""},
}
"""By interface: options that say, beside the channel, which bus it is; and what they are unless given."""
NETWORKS = ("tcp", "udp", "websocket", "yarp")
"""Interfaces of serial devices that are reached over a network."""


class BusName(NamedTuple):
    """A bus' name taken apart."""

    interface: str
    channel: str
    options: dict[str, str]


class BusPlace(NamedTuple):
    """What of a bus' name says which bus it is."""

    interface: str
    channel: str
    options: tuple[tuple[str, str], ...]
    """Those that place it, always in the same order."""


def parse_bus_name(name: str) -> BusName:
    """Take a bus' name apart.

    ``vcan0`` is ``socketcan:vcan0``, ``virtual`` an emulated skin in this process. A path, which has a slash in it
    (``/dev/ttyUSB0``, ``./port``), is a serial port; ``tcp://HOST:PORT`` and ``udp://HOST:PORT`` are streams over a
    network, ``yarp://HOST:PORT/NAME`` is a port of a robot that runs YARP. pyserial's URLs (``rfc2217://host:port``)
    are serial, too.
    python-can's interfaces of names that are ours are ``can+virtual:`` and ``can+serial:``.

    Raises:
        ConfigurationError: empty, options that are not ``key=value``, or neither a connection nor a port for Modbus.
    """
    address, _, query = name.partition("?")
    if "=" in address and "/" not in address:
        raise ConfigurationError(f"bus {name!r}: options begin with a question mark, as in virtual?lose=0.1&seed=1")
    if not address:
        raise ConfigurationError("a bus needs a name, such as vcan0, can0, /dev/ttyUSB0 or virtual")
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=True)) if query else {}
    except ValueError:
        raise ConfigurationError(f"bus {name!r}: write options as ?key=value&key=value") from None
    interface, channel = _split(address)
    if interface == "modbus":
        _check_modbus(channel, options)
    return BusName(interface, channel, options)


def is_only_asked(name: str) -> bool:
    """Whether nothing is to be heard on a bus of this name unless a device is called, or asked."""
    return _split(name.partition("?")[0])[0] in (*NETWORKS, "modbus")


def place_of_bus(name: str) -> BusPlace:
    """Which bus a name means: two names of one bus have the same place, whatever options stand in them beside that.

    Links are followed. Emulated buses are told apart by all of their options. A USB device that is named by what it is
    has the place that its name says, wherever it is plugged in. Any text has a place, also one that is no bus' name.
    """
    address, _, query = name.partition("?")
    interface, channel = _split(address)
    given = dict(parse_qsl(query, keep_blank_values=True))
    usual = dict.fromkeys(sorted(given), "") if interface == "virtual" else _PLACING.get(interface, {})
    options = tuple((key, given.get(key, value)) for key, value in usual.items())
    return BusPlace(interface, os.path.realpath(channel) if channel.startswith("/") else channel, options)


def _check_modbus(channel: str, options: Mapping[str, str]) -> None:
    """Refuse what looks like a device over TCP, or like nothing."""
    is_by_what_it_is = not channel and options.keys() & {"serial_number", "vid_pid"}
    if is_by_what_it_is or ("/" in channel and not channel.startswith("tcp:")) or channel.startswith("tcp://"):
        return
    host = channel.removeprefix("tcp:").strip("/") or "HOST"
    raise ConfigurationError(
        f"bus modbus:{channel}: over TCP that is modbus:tcp://{host}, and a serial port modbus:/dev/ttyUSB0, or"
        f" modbus:./{channel or 'port'}"
    )


def _split(address: str) -> tuple[str, str]:
    interface, colon, channel = address.partition(":")
    if interface in NETWORKS and channel.startswith("//"):
        return interface, channel[2:]
    if "/" in interface or channel.startswith("//"):  # a path, or one of pyserial's URLs
        return "serial", address
    if colon:
        return interface, channel
    return (address, "") if address in ("virtual", "pty", "serial") else ("socketcan", address)
