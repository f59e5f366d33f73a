"""Set a driver up as the command line and the configuration file of ``skin-driver`` say.

The file is TOML, read into checked structs; the nearest name is suggested for an unknown key::

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

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry, read_geometry
from skinware.memory.namespace import Namespace
from skinware.realtime import Profile, cpus_from_text
from skinware.text import nearest_name
from skinware.toml_text import Keys, TomlText, wrong_value
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, kind_of_bus
from skinware_drivers.bus_names import BusPlace
from skinware_drivers.cli.capturing import driver_of_recording, only_listened, options_of_recording
from skinware_drivers.loading import short_name
from skinware_drivers.options import is_file, options_from_strings
from skinware_drivers.registry import DEFAULT_DRIVER, NamedBus, load_driver
from skinware_drivers.running.guard import hook
from skinware_drivers.running.runner import Runner

if TYPE_CHECKING:
    from skinware_drivers.running.news import PatchChange

T = TypeVar("T", bound=msgspec.Struct)


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One bus: its name (as ``--bus`` takes it), and the options that apply to it alone."""

    name: str
    options: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigurationError("a bus has no name yet: fill in the interface that it is, as can0")


class DriverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole file, or what a command line says of it.

    Attributes:
        driver: name of a registered driver, or a file ``./my_skin.py``, relative to this file.
        wait: if no bus is available at the start, wait for one.
        publish: ``cycle``, ``rate`` or ``request``; empty: as the driver does.
        slots: size of the ring; None: the default.
        latency_ms: longest time that frames may wait so that more are taken with them, 0 to 1000; None: the default.
        realtime: a profile as :meth:`skinware.realtime.Profile.from_text` reads it.
        cpus: CPUs to stay on; empty for any.
        geometry: file with the positions of the sensors, relative to this file; empty: they are not published.
        group: whose members may read the namespace; empty: no group.
    """

    driver: str = ""
    name: str = ""
    listen_only: bool = False
    wait: bool = False
    publish: Literal["", "cycle", "rate", "request"] = ""
    slots: Annotated[int, msgspec.Meta(ge=2, le=64)] | None = None
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None
    realtime: str | None = None
    cpus: tuple[int, ...] = ()
    geometry: str = ""
    group: str = ""
    options: dict[str, Any] = {}
    bus: tuple[BusConfig, ...] = ()

    def __post_init__(self) -> None:
        # refused here, so that the message names the file
        Profile.from_text("normal" if self.realtime is None else self.realtime, cpus=self.cpus)


class ConfigFile:
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


class DriverSetup:
    """A driver with its buses and options.

    Args:
        given: the settings of the command line, by the names in ``DriverConfig``; None or False: not given.
        buses: of the command line, instead of those of the file.
        hardware: the texts of the driver's own options.
        config: the file.

    Attributes:
        profile: how it is scheduled; None: as any program.
    """

    def __init__(
        self,
        given: Mapping[str, Any],
        *,
        buses: Sequence[str],
        hardware: Mapping[str, str],
        config: Path | None,
        namespace: str | None,
    ) -> None:
        self._given = {name: value for name, value in given.items() if value is not None and value is not False}
        if "cpus" in self._given:
            self._given["cpus"] = cpus_from_text(self._given["cpus"])
        self._given_buses, self._hardware, self._config = buses, hardware, config
        self._file = ConfigFile(config)
        settings = self._settings = self._with_given(self._file)
        names = list(buses) or [bus.name for bus in settings.bus]
        named = settings.driver or driver_of_recording(names)
        self._is_named, self._driver_name = bool(named), named or DEFAULT_DRIVER
        self._driver = load_driver(self._driver_name)
        self.driver_type = short_name(self._driver_name)
        self.name = settings.name or self.driver_type
        self.namespace = Namespace(namespace)
        self.profile: Profile | None = None
        if settings.realtime is not None or settings.cpus:
            self.profile = Profile.from_text(settings.realtime or "normal", cpus=settings.cpus)
        self._listen_only = settings.listen_only or only_listened(names)
        if not names:
            raise ConfigurationError("which bus? give --bus (vcan0, can0, virtual ...) or a --config with one")
        self._buses = self._named(names)
        own = [bus.name for bus in settings.bus]
        for name in buses:  # it would silently lack the options that the file has for its own buses
            if name not in own and any(bus.options for bus in settings.bus):
                raise ConfigurationError(
                    f"--bus {name}: the file has options for {', '.join(own)} and none for this bus;"
                    " change the name there"
                )

    def make_runner(self, on_ready: Callable[[], None], on_patches: Callable[[PatchChange], None]) -> Runner:
        """Return the driver, which does not run yet; see :class:`Runner` for the arguments."""
        settings, latency_ms = self._settings, self._settings.latency_ms
        adapters = [self._make_adapter(bus, self._file) for bus in self._buses]
        lines = [
            (bus.text, adapter, self._make_bus(bus, adapter, self._file))
            for bus, adapter in zip(self._buses, adapters, strict=True)
        ]
        return Runner(
            self.driver_type,
            lines,
            name=self.name,
            listen_only=self._listen_only,
            wait_for_buses=settings.wait,
            publish=settings.publish or None,
            latency_s=None if latency_ms is None else latency_ms / 1e3,
            namespace=self.namespace,
            slots=settings.slots,
            group=settings.group or None,
            geometry=_geometry(settings),
            on_ready=on_ready,
            on_patches=on_patches,
        )

    async def read_again(self, runner: Runner) -> None:
        """Read the files again, and change the buses and places of a running driver to what they say now."""
        file = ConfigFile(self._config)
        settings = self._with_given(file)
        geometry = _geometry(settings)
        if self._config is not None and not self._given_buses:  # those of the command line stay
            wanted_driver = settings.driver or DEFAULT_DRIVER
            if wanted_driver != self._driver_name:
                raise ConfigurationError(
                    f"{self._config}: driver = {wanted_driver!r}, and {self._driver_name!r} is running: stop it and"
                    " start it again"
                )
            buses = {bus.text: bus for bus in self._named([bus.name for bus in settings.bus])}
            adapters = {name: self._make_adapter(bus, file) for name, bus in buses.items()}
            await runner.buses.change_to(adapters, lambda name, adapter: self._make_bus(buses[name], adapter, file))
        await runner.change_geometry(geometry)

    def _with_given(self, file: ConfigFile) -> DriverConfig:
        return msgspec.structs.replace(file.settings, **self._given)

    def _named(self, texts: Sequence[str]) -> list[NamedBus]:
        """Refuse a bus that is named twice: its boards would be set up twice."""
        buses: dict[BusPlace, NamedBus] = {}
        for bus in (NamedBus(text, self._driver_name) for text in texts):
            if (other := buses.setdefault(bus.name.place, bus)) is not bus:
                also = f", also as {other.text}" if other.text != bus.text else ""
                raise ConfigurationError(f"bus {bus.text} is named twice{also}; name each bus once")
        return list(buses.values())

    def _make_adapter(self, bus: NamedBus, file: ConfigFile) -> AnyAdapter:
        recorded = options_of_recording(bus.text, self.driver_type)
        options = file.options_of_bus(self._driver.Options, bus.text, self._hardware, recorded)
        with file.blamed_for(bus.text):
            with hook("__init__", bus.text):
                adapter = bus.choose(self._driver)(options)
            adapter.check()
        return adapter

    def _make_bus(self, bus: NamedBus, adapter: AnyAdapter, file: ConfigFile) -> Bus:
        with file.blamed_for(bus.text):
            made = bus.make(payload_size=adapter.payload_size, listen_only=self._listen_only)
            if not self._is_named and not made.fits(adapter.medium):
                raise ConfigurationError(
                    f"{made.name} is {kind_of_bus(made.medium)}: give its driver with --driver. Without it, that is"
                    f" {self._driver_name}, on {kind_of_bus(adapter.medium)}{made.instead(adapter.medium)}"
                )
            return made


def _geometry(settings: DriverConfig) -> Geometry | None:
    return read_geometry(settings.geometry) if settings.geometry else None
