"""Which options a driver and an emulator have stands in the brackets of their base, and nowhere else."""

from __future__ import annotations

from typing import Annotated, Any, Generic, TypeVar

import click
import msgspec
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.can import CanAdapter
from skinware_drivers.cli import driver, emulate
from skinware_drivers.cli.hardware_options import reserved_names
from skinware_drivers.options import HasOptions, NoOptions
from skinware_drivers.virtual import Emulator, EmulatorOptions
from tests.testing.fingertips import EmulatedFingertips, Fingertips

OptionsT = TypeVar("OptionsT", bound=msgspec.Struct)
Other = TypeVar("Other")


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    period_ms: Annotated[int, msgspec.Meta(ge=0)] = 40


class MoreOptions(Options, frozen=True, forbid_unknown_fields=True):
    fast: bool = False


class EmulatedOptions(EmulatorOptions, frozen=True):
    period_ms: int = 40


class Driver(CanAdapter[Options]):
    pass


def test_the_class_in_the_brackets_is_that_of_the_options() -> None:
    assert Driver.Options is Options
    assert Driver(Options()).options == Options(40)
    assert Fingertips.Options is NoOptions
    assert EmulatedFingertips.Options is EmulatorOptions


def test_a_subclass_has_those_of_its_base() -> None:
    class Same(Driver):
        pass

    class More(Driver):
        Options = MoreOptions

    class StillMore(More):
        pass

    assert Same.Options is Options
    assert More.Options is MoreOptions
    assert StillMore.Options is MoreOptions


def test_a_class_between_may_leave_it_open() -> None:
    class Between(CanAdapter[OptionsT], Generic[Other, OptionsT]):
        pass

    class Named(Between[int, Options]):
        pass

    assert Between.Options is NoOptions
    assert Named.Options is Options


@pytest.mark.parametrize("wrong", [int, Any, "Options"])
def test_what_is_no_class_of_options_is_refused(wrong: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"class Wrong: its base has .* in brackets.* msgspec\.Struct"):
        type("Wrong", (CanAdapter,), {"__orig_bases__": (CanAdapter[wrong],)})


def test_an_emulator_needs_the_options_that_all_emulators_have() -> None:
    with pytest.raises(ConfigurationError, match=r"has Options in brackets.* .*EmulatorOptions"):

        class Emulated(Emulator[Options]):  # type: ignore[type-var]
            pass


def test_a_line_that_says_something_else_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="Options = NoOptions contradicts the Options that"):

        class Twice(CanAdapter[Options]):
            Options = NoOptions


def test_an_option_period_ms_is_the_period() -> None:
    class Emulated(Emulator[EmulatedOptions]):
        full_scale = swing = 1

        def places(self) -> Any:
            raise NotImplementedError

        def frames(self, device: Any, values: Any) -> Any:
            raise NotImplementedError

    assert Driver(Options(period_ms=7)).period_s == 0.007
    assert Emulated(EmulatedOptions()).period_s == 0.04
    assert Driver(Options(period_ms=0)).period_s == Driver.period_s == 0.02  # 0: that of the device, say
    assert Fingertips(NoOptions()).period_s == 0.02


@pytest.mark.parametrize("name", ["slots", "group", "listen_only", "latency", "help", "systemd"])
def test_an_option_that_skin_driver_would_hide_is_refused(name: str) -> None:
    hidden = msgspec.defstruct("Hidden", [(name, int, 1)], frozen=True)
    flag = name.replace("_", "-")
    with pytest.raises(
        ConfigurationError, match=f"class Rack: its option '{name}' .*--{flag} of skin-driver.*'device_"
    ):
        type("Rack", (CanAdapter,), {"__orig_bases__": (CanAdapter[hidden],)})  # type: ignore[valid-type]


def test_an_option_is_hidden_by_the_name_that_is_written() -> None:
    class Renamed(msgspec.Struct, frozen=True, rename={"rack": "slots"}):
        rack: int = 1

    with pytest.raises(ConfigurationError, match="'slots'"):

        class Rack(CanAdapter[Renamed]):
            pass


def test_an_option_that_skin_emulate_would_hide_is_refused() -> None:
    hidden = msgspec.defstruct("Hidden", [("log", int, 1)], bases=(EmulatorOptions,), frozen=True, kw_only=True)
    with pytest.raises(ConfigurationError, match=r"class Rack: its option 'log' .*--log of skin-emulate"):
        type("Rack", (Emulator,), {"__orig_bases__": (Emulator[hidden],)})  # type: ignore[valid-type]


@pytest.mark.parametrize(("command", "base"), [(driver.command, CanAdapter), (emulate.command, Emulator)])
def test_the_reserved_names_are_those_of_the_commands(command: click.Command, base: type[HasOptions[Any]]) -> None:
    assert base.reserved_options == reserved_names(command)
    assert base.options_command == command.name
