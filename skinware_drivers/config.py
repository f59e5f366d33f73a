"""A driver's configuration file: TOML into checked structs; an unknown key is refused with the nearest right one.

::

    driver = "roboskin"
    name = "torso"
    realtime = "fifo:50"
    cpus = [1]

    [options]               # of every bus
    period_ms = 50

    [[bus]]
    name = "can0"
    options = { boards = [7, 8, 9, 10] }
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.realtime import Profile
from skinware_drivers.options import nearest_name, options_from_strings

T = TypeVar("T", bound=msgspec.Struct)


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One bus: its name (as ``--bus`` takes it), and driver options that hold for it alone."""

    name: str
    options: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigurationError("a bus has no name yet: fill in the interface that it is, as can0")


class DriverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole file.

    Attributes:
        publish: when frames are published: ``cycle``, ``rate`` or ``request``; empty: as the driver does.
        realtime: a profile as :meth:`skinware.realtime.Profile.from_text` reads it.
        cpus: CPUs to stay on; empty for any.
    """

    driver: str = ""
    name: str = ""
    listen_only: bool = False
    publish: Literal["", "cycle", "rate", "request"] = ""
    realtime: str | None = None
    cpus: tuple[int, ...] = ()
    options: dict[str, Any] = {}
    bus: tuple[BusConfig, ...] = ()

    def __post_init__(self) -> None:
        # refused here, the message names the file
        Profile.from_text("normal" if self.realtime is None else self.realtime, cpus=self.cpus)


def read_config(path: Path) -> DriverConfig:
    """Read a configuration file.

    Raises:
        ConfigurationError: not there, not TOML, or a key or value that is wrong; the message says where.
    """
    try:
        with path.open("rb") as file:
            data = tomllib.load(file)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not TOML: {error}") from None
    check_keys(DriverConfig, data, str(path))
    for number, bus in enumerate(data["bus"] if isinstance(data.get("bus"), list) else []):
        check_keys(BusConfig, bus, f"{path}: bus {number + 1}")
    return convert(DriverConfig, data, str(path))


def options_of_bus(struct: type[T], settings: DriverConfig, bus_name: str, given: Mapping[str, str] | None = None) -> T:
    """A driver's options for one bus: what is given as text beats the bus' own, they beat the file's common ones.

    Args:
        struct: the driver's ``Options``.
        settings: the file.
        bus_name: as it stands in the file.
        given: ``key=value`` texts, say of a command line.

    Raises:
        ConfigurationError: an unknown option or a wrong value.
    """
    of_bus = next((bus.options for bus in settings.bus if bus.name == bus_name), {})
    values = {**settings.options, **of_bus}
    if given:
        as_given = options_from_strings(struct, given)
        values.update({key: getattr(as_given, key) for key in given})
    return convert(struct, values, f"options of {bus_name}")


def convert(struct: type[T], data: Mapping[str, Any], where: str) -> T:
    """``data`` as a struct.

    Raises:
        ConfigurationError: an unknown key or a wrong value; the message begins with ``where``.
    """
    check_keys(struct, data, where)
    try:
        return msgspec.convert(data, struct)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None
    except msgspec.ValidationError as error:
        if isinstance(error.__cause__, ConfigurationError):
            raise ConfigurationError(f"{where}: {error.__cause__}") from None
        raise ConfigurationError(f"{where}: {str(error).replace('`', '')}") from None


def check_keys(struct: type[msgspec.Struct], data: object, where: str) -> None:
    """Refuse keys that a struct does not have.

    Raises:
        ConfigurationError: one of them, with the nearest right name.
    """
    known = [field.encode_name for field in msgspec.structs.fields(struct)]
    for key in data if isinstance(data, Mapping) else ():
        if key not in known:
            raise ConfigurationError(f"{where}: unknown key {key!r}{nearest_name(key, known)}")
