"""Read a driver's configuration file: TOML into checked structs; the nearest name is suggested for an unknown key.

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

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.realtime import Profile
from skinware.text import nearest_name
from skinware.toml_text import Keys, TomlText, wrong_value
from skinware_drivers.options import is_file, options_from_strings

T = TypeVar("T", bound=msgspec.Struct)


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One bus: its name (as ``--bus`` takes it), and the options that apply to it alone."""

    name: str
    options: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigurationError("a bus has no name yet: fill in the interface that it is, as can0")


class DriverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole file.

    Attributes:
        driver: name of a registered driver, or a file ``./my_skin.py``, relative to this file.
        wait: if no bus is available at the start, wait for one.
        publish: ``cycle``, ``rate`` or ``request``; empty: as the driver does.
        latency_ms: longest time that frames may wait so that more are taken with them, 0 to 1000; None: the default.
        realtime: a profile as :meth:`skinware.realtime.Profile.from_text` reads it.
        cpus: CPUs to stay on; empty for any.
        geometry: file with the positions of the sensors, relative to this file; empty: they are not published.
    """

    driver: str = ""
    name: str = ""
    listen_only: bool = False
    wait: bool = False
    publish: Literal["", "cycle", "rate", "request"] = ""
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None
    realtime: str | None = None
    cpus: tuple[int, ...] = ()
    geometry: str = ""
    options: dict[str, Any] = {}
    bus: tuple[BusConfig, ...] = ()

    def __post_init__(self) -> None:
        # refused here, so that the message names the file
        Profile.from_text("normal" if self.realtime is None else self.realtime, cpus=self.cpus)


class ConfigFile:
    """A configuration file, or none; errors name file, line and key."""

    def __init__(self, path: Path | None) -> None:
        self._text = TomlText(path)
        self.settings = DriverConfig()
        if path is None:
            return
        data = self._text.data
        try:
            _check_keys(DriverConfig, data, hint="; options of the driver belong below [options]")
            buses = data.get("bus", [])
            if not isinstance(buses, list) or not all(isinstance(bus, Mapping) for bus in buses):
                raise _Wrong('each bus is a table: a line [[bus]], and below it a line such as name = "can0"', ("bus",))
            for number, bus in enumerate(buses):
                _check_keys(BusConfig, bus, ("bus", number))
            settings = _convert(DriverConfig, data)
        except _Wrong as wrong:
            raise ConfigurationError(f"{self._text.place(wrong.keys)}: {wrong}") from None
        if is_file(settings.driver):
            settings = msgspec.structs.replace(settings, driver=str(path.parent / settings.driver))
        if settings.geometry:
            settings = msgspec.structs.replace(settings, geometry=str(path.parent / settings.geometry))
        self.settings = settings

    def options_of_bus(
        self,
        struct: type[T],
        bus_name: str,
        given: Mapping[str, str] | None = None,
        usual: Mapping[str, Any] | None = None,
    ) -> T:
        """Return a driver's options for one bus: given texts override the bus' own options, these the common ones."""
        number, of_bus = next(
            ((i, bus.options) for i, bus in enumerate(self.settings.bus) if bus.name == bus_name), (0, {})
        )
        values = {**(usual or {}), **self.settings.options, **of_bus}
        as_given = options_from_strings(struct, given) if given else None
        values.update({key: getattr(as_given, key) for key in given or ()})
        try:
            return _convert(struct, values)
        except _Wrong as wrong:
            key = next(iter(wrong.keys), None)
            if key in of_bus or (key is None and of_bus):
                place = self._text.place(("bus", number, "options", *wrong.keys))
            elif key in self.settings.options or (key is None and self.settings.options):
                place = self._text.place(("options", *wrong.keys))
            else:
                raise ConfigurationError(f"options of {bus_name}: {wrong}") from None
            raise ConfigurationError(f"{place}: options of {bus_name}: {wrong}") from None

    @contextmanager
    def blamed_for(self, bus_name: str) -> Iterator[None]:
        try:
            yield
        except ConfigurationError as error:
            numbers = [number for number, bus in enumerate(self.settings.bus) if bus.name == bus_name]
            if not numbers:
                raise
            raise ConfigurationError(f"{self._text.place(('bus', numbers[0], 'name'))}: {error}") from None


class _Wrong(Exception):
    def __init__(self, text: str, keys: Keys) -> None:
        super().__init__(text)
        self.keys = keys


def _convert(struct: type[T], data: Mapping[str, Any]) -> T:
    _check_keys(struct, data)
    try:
        return msgspec.convert(data, struct)
    except ConfigurationError as error:
        raise _Wrong(str(error), ()) from None
    except msgspec.ValidationError as error:
        text, keys = wrong_value(error, struct)
        raise _Wrong(str(error.__cause__) if isinstance(error.__cause__, ConfigurationError) else text, keys) from None


def _check_keys(struct: type[msgspec.Struct], data: object, place: Keys = (), hint: str = "") -> None:
    known = [field.encode_name for field in msgspec.structs.fields(struct)]
    for key in data if isinstance(data, Mapping) else ():
        if key not in known:
            of_bus = f"bus {place[1] + 1}: " if len(place) > 1 and isinstance(place[1], int) else ""
            raise _Wrong(f"{of_bus}unknown key {key!r}{nearest_name(key, sorted(known))}{hint}", (*place, key))
