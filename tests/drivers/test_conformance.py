"""Every driver that ships, on its emulated devices."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from skinware_drivers.can.allegro_v5 import AllegroV5Driver, AllegroV5UdpDriver
from skinware_drivers.can.barrett import BarrettDriver
from skinware_drivers.can.canopen_patch import CanopenDriver
from skinware_drivers.can.cyskin_cpm import CyskinCpmDriver
from skinware_drivers.can.linkerhand import LinkerHandDriver
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.xela import XelaDriver
from skinware_drivers.modbus.dfrobot import DfrobotDriver
from skinware_drivers.modbus.inspire import InspireDriver
from skinware_drivers.modbus.revo2 import Revo2Driver
from skinware_drivers.modbus.revo3 import Revo3Driver
from skinware_drivers.serial.ability_hand import AbilityHandDriver
from skinware_drivers.serial.agni import AgniDriver
from skinware_drivers.serial.anyskin import AnySkinDriver
from skinware_drivers.serial.contactile import Dev001Driver, PapillArrayDriver
from skinware_drivers.serial.flexitac import FlexiTacDriver
from skinware_drivers.serial.openpatch import OpenPatchDriver
from skinware_drivers.serial.paxini import PaxiniDriver
from skinware_drivers.serial.robotiq_tsf import RobotiqTsfDriver
from skinware_drivers.serial.skintalk import SkintalkDriver
from skinware_drivers.serial.tactile_glove import TactileGloveDriver
from skinware_drivers.serial.weiss import WeissDsaDriver, WeissWtsDriver
from skinware_drivers.serial.wuji_glove import WujiGloveDriver
from skinware_drivers.streams.dex3 import Dex3Driver
from skinware_drivers.streams.icub_eth import IcubEthDriver
from skinware_drivers.streams.ros2 import Ros2Driver
from skinware_drivers.streams.tesollo import TesolloDriver
from skinware_drivers.streams.xela_server import XelaServerDriver
from skinware_drivers.streams.yarp import YarpDriver
from skinware_drivers.virtual.devices.ability_hand import EmulatedAbilityHand
from skinware_drivers.virtual.devices.agni import EmulatedAgni
from skinware_drivers.virtual.devices.allegro_v5 import EmulatedAllegroV5, EmulatedAllegroV5Tips, EmulatedAllegroV5Udp
from skinware_drivers.virtual.devices.anyskin import EmulatedAnySkin
from skinware_drivers.virtual.devices.barrett import EmulatedBarrett
from skinware_drivers.virtual.devices.canopen_patch import EmulatedCanopen
from skinware_drivers.virtual.devices.contactile import EmulatedDev001, EmulatedPapillArray
from skinware_drivers.virtual.devices.cyskin_cpm import EmulatedCyskinCpm
from skinware_drivers.virtual.devices.dds import EmulatedDex3, EmulatedRos2
from skinware_drivers.virtual.devices.flexitac import EmulatedFlexiTac
from skinware_drivers.virtual.devices.icub_eth import EmulatedIcubEth
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand
from skinware_drivers.virtual.devices.openpatch import EmulatedOpenPatch
from skinware_drivers.virtual.devices.paxini import EmulatedPaxini
from skinware_drivers.virtual.devices.registers import EmulatedDfrobot, EmulatedInspire, EmulatedRevo2, EmulatedRevo3
from skinware_drivers.virtual.devices.robotiq_tsf import EmulatedRobotiqTsf
from skinware_drivers.virtual.devices.skintalk import EmulatedSkintalk
from skinware_drivers.virtual.devices.tactile_glove import EmulatedTactileGlove
from skinware_drivers.virtual.devices.tesollo import EmulatedTesollo
from skinware_drivers.virtual.devices.weiss import EmulatedWeissDsa, EmulatedWeissWts
from skinware_drivers.virtual.devices.wuji_glove import EmulatedWujiGlove
from skinware_drivers.virtual.devices.xela import EmulatedXela, EmulatedXelaServer
from skinware_drivers.virtual.devices.yarp import EmulatedYarp
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.drivers.fd_patch import EmulatedFdPatch, FdPatchDriver
from tests.specification.path_tests import DriverConformance


class TestXela(DriverConformance):
    driver = XelaDriver
    emulator = EmulatedXela


@pytest.mark.thorough
class TestXela4x6(DriverConformance):
    driver = XelaDriver
    emulator = EmulatedXela
    driver_options: ClassVar[Mapping[str, Any]] = {
        "boards": (1, 3),
        "ids": "row_column",
        "first_id": (0x100, 0x200),
        "columns": 6,
    }
    emulator_options: ClassVar[Mapping[str, Any]] = {"boards": (1, 3), "model": "4x6"}


class TestCanopen(DriverConformance):
    driver = CanopenDriver
    emulator = EmulatedCanopen
    driver_options: ClassVar[Mapping[str, Any]] = {"nodes": (5, 6)}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        """The example patch also sends that it has 25.0 degrees."""
        return [*felt, 250]


class TestCyskinCpm(DriverConformance):
    driver = CyskinCpmDriver
    emulator = EmulatedCyskinCpm


class TestBarrett(DriverConformance):
    driver = BarrettDriver
    emulator = EmulatedBarrett


@pytest.mark.thorough
class TestBarrettTop10(DriverConformance):
    driver = BarrettDriver
    emulator = EmulatedBarrett
    driver_options: ClassVar[Mapping[str, Any]] = {"format": "top10", "nodes": (11, 14)}
    emulator_options: ClassVar[Mapping[str, Any]] = {"nodes": (11, 14)}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        """In N/cm2; of equals, the first."""
        weakest_last = sorted((-value, cell) for cell, value in enumerate(felt))
        listed = {cell for _, cell in weakest_last[:10]}
        return [value // 256 if cell in listed else 0 for cell, value in enumerate(felt)]


class TestLinkerHand(DriverConformance):
    """It asks."""

    driver = LinkerHandDriver
    emulator = EmulatedLinkerHand
    driver_options: ClassVar[Mapping[str, Any]] = {"ask": True}
    emulator_options: ClassVar[Mapping[str, Any]] = {"program_ms": 0}


@pytest.mark.thorough
class TestLinkerHandBesideItsProgram(DriverConformance):
    """Two hands of ten by four, whose own program asks."""

    driver = LinkerHandDriver
    emulator = EmulatedLinkerHand
    driver_options: ClassVar[Mapping[str, Any]] = {"hands": (0x27, 0x28), "touch": "10x4"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"hands": (0x27, 0x28), "touch": "10x4"}


@pytest.mark.thorough
class TestLinkerHandFingers(DriverConformance):
    driver = LinkerHandDriver
    emulator = EmulatedLinkerHand
    driver_options: ClassVar[Mapping[str, Any]] = {"ask": True, "touch": "fingers_90"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"program_ms": 0, "touch": "fingers_90"}


@pytest.mark.thorough
class TestLinkerHandWhole(DriverConformance):
    """Matrices in runs of five, those of the palm longer than those of the fingers."""

    driver = LinkerHandDriver
    emulator = EmulatedLinkerHand
    driver_options: ClassVar[Mapping[str, Any]] = {"ask": True}
    emulator_options: ClassVar[Mapping[str, Any]] = {"program_ms": 0, "touch": "hand_12x6", "palm": True}


class TestAllegroV5(DriverConformance):
    driver = AllegroV5Driver
    emulator = EmulatedAllegroV5


@pytest.mark.thorough
class TestAllegroV5Tips(DriverConformance):
    driver = AllegroV5Driver
    emulator = EmulatedAllegroV5Tips


@pytest.mark.thorough
class TestAllegroV5Udp(DriverConformance):
    driver = AllegroV5UdpDriver
    emulator = EmulatedAllegroV5Udp


class EmulatedTriangles(EmulatedRoboskin):
    """Boards whose sixteen triangles have twelve channels each."""

    full_scale = 0xFF

    def __init__(
        self,
        options: EmulatedRoboskinOptions,
        *,
        log: EventLog | None = None,
        source: Callable[[int, int], Sequence[int]] | None = None,
    ) -> None:
        felt: dict[int, tuple[int, Sequence[int]]] = {}

        def of_triangle(board: int, triangle: int, cycle: int, _time_ns: int) -> Sequence[int]:
            assert source is not None
            if board not in felt or felt[board][0] != cycle:
                felt[board] = cycle, source(board, cycle)
            return felt[board][1][12 * triangle : 12 * triangle + 12]

        super().__init__(options, log=log, source=of_triangle)
        self.numbers = options.boards

    def places(self) -> npt.NDArray[Any]:
        return np.zeros((192, 2))


class TestRoboskin(DriverConformance):
    driver = RoboskinDriver
    emulator = EmulatedTriangles


class TestRoboskinMtb3(DriverConformance):
    driver = RoboskinDriver
    emulator = EmulatedTriangles
    driver_options: ClassVar[Mapping[str, Any]] = {"boards": (3, 4)}
    emulator_options: ClassVar[Mapping[str, Any]] = {"boards": (3, 4), "mtb3": (3,)}


class TestOpenPatch(DriverConformance):
    driver = OpenPatchDriver
    emulator = EmulatedOpenPatch


@pytest.mark.thorough
class TestFdPatch(DriverConformance):
    """CAN FD and 29-bit identifiers."""

    driver = FdPatchDriver
    emulator = EmulatedFdPatch


class TestAnySkin(DriverConformance):
    driver = AnySkinDriver
    emulator = EmulatedAnySkin


class TestTactileGlove(DriverConformance):
    driver = TactileGloveDriver
    emulator = EmulatedTactileGlove


class TestSkintalk(DriverConformance):
    driver = SkintalkDriver
    emulator = EmulatedSkintalk
    driver_options: ClassVar[Mapping[str, Any]] = {"patches": (1, 4), "cells": 12}
    emulator_options: ClassVar[Mapping[str, Any]] = {"patches": (1, 4), "cells": 12}


class TestWeissWts(DriverConformance):
    driver = WeissWtsDriver
    emulator = EmulatedWeissWts


class TestWeissDsa(DriverConformance):
    driver = WeissDsaDriver
    emulator = EmulatedWeissDsa


class TestTesollo(DriverConformance):
    driver = TesolloDriver
    emulator = EmulatedTesollo


@pytest.mark.thorough
class TestTesolloPads(DriverConformance):
    """Three of five fingers have sensors of 16 bits."""

    driver = TesolloDriver
    emulator = EmulatedTesollo
    emulator_options: ClassVar[Mapping[str, Any]] = {"tips": "tactile_s", "fitted": 0b01011, "pads": True}


class TestXelaServer(DriverConformance):
    driver = XelaServerDriver
    emulator = EmulatedXelaServer

    def shown(self, felt: Sequence[int]) -> Sequence[Any]:
        return [value / 256 for value in felt]


@pytest.mark.thorough
class TestXelaServerCounts(DriverConformance):
    driver = XelaServerDriver
    emulator = EmulatedXelaServer
    emulator_options: ClassVar[Mapping[str, Any]] = {"sensors": (1, 3), "model": "uSCuAH", "calibrated": False}


class TestYarp(DriverConformance):
    driver = YarpDriver
    emulator = EmulatedYarp
    emulator_options: ClassVar[Mapping[str, Any]] = {"length": 41, "envelope": False}


@pytest.mark.thorough
class TestYarpOfARobotsFiles(DriverConformance):
    driver = YarpDriver
    emulator = EmulatedYarp
    driver_options: ClassVar[Mapping[str, Any]] = {
        "length": 48,
        "triangles": [{"board": 7, "first": 0, "triangles": [0, 1, 2, 3], "kind": "fingertip"}],
    }
    emulator_options: ClassVar[Mapping[str, Any]] = {"length": 48}


class TestRos2(DriverConformance):
    """Two topics of arrays."""

    driver = Ros2Driver
    emulator = EmulatedRos2
    driver_options: ClassVar[Mapping[str, Any]] = {"topic": ("/left", "/right")}
    emulator_options: ClassVar[Mapping[str, Any]] = {"topics": (0, 1)}


@pytest.mark.thorough
class TestRos2Image(DriverConformance):
    driver = Ros2Driver
    emulator = EmulatedRos2
    emulator_options: ClassVar[Mapping[str, Any]] = {"message": "image"}


@pytest.mark.thorough
class TestRos2Points(DriverConformance):
    driver = Ros2Driver
    emulator = EmulatedRos2
    emulator_options: ClassVar[Mapping[str, Any]] = {"message": "points"}


@pytest.mark.thorough
class TestRos2Sensors(DriverConformance):
    """Two modules of one message."""

    driver = Ros2Driver
    emulator = EmulatedRos2
    emulator_options: ClassVar[Mapping[str, Any]] = {"message": "sensors"}


class TestIcubEth(DriverConformance):
    driver = IcubEthDriver
    emulator = EmulatedIcubEth


@pytest.mark.thorough
class TestIcubEthSecondPort(DriverConformance):
    driver = IcubEthDriver
    emulator = EmulatedIcubEth
    driver_options: ClassVar[Mapping[str, Any]] = {"port": 2}
    emulator_options: ClassVar[Mapping[str, Any]] = {"boards": (3, 9), "triangles": 4, "skin": 1}


class TestWujiGlove(DriverConformance):
    driver = WujiGloveDriver
    emulator = EmulatedWujiGlove

    def shown(self, felt: Sequence[int]) -> Sequence[Any]:
        return [value / 4096 for value in felt]


class TestAgni(DriverConformance):
    driver = AgniDriver
    emulator = EmulatedAgni


class TestFlexiTac(DriverConformance):
    driver = FlexiTacDriver
    emulator = EmulatedFlexiTac


@pytest.mark.thorough
class TestFlexiTacText(DriverConformance):
    """The older firmware, in its own size."""

    driver = FlexiTacDriver
    emulator = EmulatedFlexiTac
    driver_options: ClassVar[Mapping[str, Any]] = {"firmware": "text"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"firmware": "text", "rows": 16, "columns": 16, "period_ms": 31}


class TestAbilityHand(DriverConformance):
    driver = AbilityHandDriver
    emulator = EmulatedAbilityHand


class TestDev001(DriverConformance):
    driver = Dev001Driver
    emulator = EmulatedDev001

    def shown(self, felt: Sequence[int]) -> Sequence[Any]:
        return [float(np.float32(value / 1e3)) for value in felt]


class TestPapillArray(DriverConformance):
    """Two sensors; whole numbers are slip states, the others thousandths."""

    driver = PapillArrayDriver
    emulator = EmulatedPapillArray

    def shown(self, felt: Sequence[int]) -> Sequence[Any]:
        states = (*range(60, 69), 78)
        return [value if at % 81 in states else float(np.float32(value / 1e3)) for at, value in enumerate(felt)]


def with_resultant(bytes_felt: Sequence[int]) -> list[int]:
    """Of one module of Paxini's: forces along the normal have no sign; behind all taxels comes the sum of each axis."""
    taxels = np.array(bytes_felt).reshape(-1, 3)
    taxels[:, 2] &= 0xFF
    return [*taxels.ravel().tolist(), *np.clip(taxels.sum(axis=0), (-128, -128, 0), (127, 127, 255)).tolist()]


class TestPaxiniConverter(DriverConformance):
    """Two sensors that are asked."""

    driver = PaxiniDriver
    emulator = EmulatedPaxini
    driver_options: ClassVar[Mapping[str, Any]] = {"sensors": (1, 3)}
    emulator_options: ClassVar[Mapping[str, Any]] = {
        "sensors": (1, 3),
        "sensor_version": "PAXINI PXSR-STDIP03B-v1.0.5",
        "points": 25,
    }

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        return with_resultant(felt)


@pytest.mark.thorough
class TestPaxiniHighSpeed(DriverConformance):
    """Modules of different size on two fingers and the palm, streamed together."""

    driver = PaxiniDriver
    emulator = EmulatedPaxini
    driver_options: ClassVar[Mapping[str, Any]] = {"board": "high_speed"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"board": "high_speed", "slots": (2, 5, 20, 27), "points": 25}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        edges = np.cumsum([0, 75, 75, 27, 27])
        return [value for a, b in pairwise(edges) for value in with_resultant(felt[a:b])]


class TestInspire(DriverConformance):
    driver = InspireDriver
    emulator = EmulatedInspire


class TestDfrobot(DriverConformance):
    """Two arrays, which are asked for their shape."""

    driver = DfrobotDriver
    emulator = EmulatedDfrobot
    driver_options: ClassVar[Mapping[str, Any]] = {"units": (1, 31)}
    emulator_options: ClassVar[Mapping[str, Any]] = {"units": (1, 31)}


@pytest.mark.thorough
class TestDfrobot4x8(DriverConformance):
    """Whose shape is not asked, and whose cells are read alone."""

    driver = DfrobotDriver
    emulator = EmulatedDfrobot
    driver_options: ClassVar[Mapping[str, Any]] = {"shapes": ("4x8",), "state": False}
    emulator_options: ClassVar[Mapping[str, Any]] = {"shapes": ("4x8",)}


class TestRevo2(DriverConformance):
    driver = Revo2Driver
    emulator = EmulatedRevo2

    def shown(self, felt: Sequence[int]) -> Sequence[Any]:
        """Proximities have 32 bits, of which float32 keeps 24."""
        return [float(np.float32(value)) for value in felt]


class EmulatedPressureRevo2(EmulatedRevo2):
    full_scale = 0xFFFF


@pytest.mark.thorough
class TestRevo2Pressure(DriverConformance):
    driver = Revo2Driver
    emulator = EmulatedPressureRevo2
    emulator_options: ClassVar[Mapping[str, Any]] = {"edition": "pressure"}


class EmulatedForce3dRevo2(EmulatedRevo2):
    full_scale = 127


@pytest.mark.thorough
class TestRevo2Force3d(DriverConformance):
    driver = Revo2Driver
    emulator = EmulatedForce3dRevo2
    emulator_options: ClassVar[Mapping[str, Any]] = {"edition": "force3d"}


@pytest.mark.thorough
class TestRevo2ArrayPressure(DriverConformance):
    driver = Revo2Driver
    emulator = EmulatedPressureRevo2
    emulator_options: ClassVar[Mapping[str, Any]] = {"edition": "array_pressure"}


@pytest.mark.thorough
class TestRevo2ThatIsSwitchedOn(TestRevo2):
    driver_options: ClassVar[Mapping[str, Any]] = {"enable": True}
    emulator_options: ClassVar[Mapping[str, Any]] = {"enabled": False}


class TestRevo3(DriverConformance):
    driver = Revo3Driver
    emulator = EmulatedRevo3


@pytest.mark.thorough
class TestRevo3Sums(DriverConformance):
    driver = Revo3Driver
    emulator = EmulatedRevo3
    emulator_options: ClassVar[Mapping[str, Any]] = {"sums": True, "side": "left"}


@pytest.mark.thorough
class TestRevo3Matrix(DriverConformance):
    driver = Revo3Driver
    emulator = EmulatedRevo3
    driver_options: ClassVar[Mapping[str, Any]] = {"mapping": "matrix"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"mapping": "matrix", "values": "force"}


class EmulatedPackedRevo3(EmulatedRevo3):
    full_scale = 0xFF


@pytest.mark.thorough
class TestRevo3Packed(DriverConformance):
    driver = Revo3Driver
    emulator = EmulatedPackedRevo3
    driver_options: ClassVar[Mapping[str, Any]] = {"mapping": "packed"}
    emulator_options: ClassVar[Mapping[str, Any]] = {"mapping": "packed", "values": "force", "adc_pads": (1, 4)}


def test_every_driver_that_ships_is_here() -> None:
    """As the package's metadata names them; installed metadata may be older."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    names = set(project["project"]["entry-points"]["skinware.drivers"].values())
    suites = [suite for suite in globals().values() if isinstance(suite, type) and issubclass(suite, DriverConformance)]
    tested = [suite.driver for suite in suites if suite is not DriverConformance]
    assert names <= {f"{driver.__module__}:{driver.__qualname__}" for driver in tested}


class TestDex3(DriverConformance):
    driver = Dex3Driver
    emulator = EmulatedDex3


class TestRobotiqTsf(DriverConformance):
    driver = RobotiqTsfDriver
    emulator = EmulatedRobotiqTsf


@pytest.mark.thorough
class TestRobotiqTsfWithoutTime(DriverConformance):
    driver = RobotiqTsfDriver
    emulator = EmulatedRobotiqTsf
    emulator_options: ClassVar[Mapping[str, Any]] = {"timed": False, "fingers": (1,)}
