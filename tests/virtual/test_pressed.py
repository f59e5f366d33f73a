"""An emulated skin is pressed at a place, and its frames show it there and nowhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions as DriverOptions
from skinware_drivers.description import assemble
from skinware_drivers.virtual.bus import PlacedCanBus, VirtualCanBus, virtual_bus
from skinware_drivers.virtual.hardware import PlacedHardware, Pressing
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions

from .rig import START_NS, Rig
from .test_touch import TACTILE

BOARDS = (7, 8, 9, 10)


def felt(rig: Rig, duration_ms: float) -> npt.NDArray[np.int64]:
    """(n_boards, 16, 12) the last values on the wire, pressure-positive around 0."""
    found = np.zeros((len(BOARDS), 16, 12), np.int64)
    for frame in rig.run_ms(duration_ms):
        if frame.identifier >> 8 == 4:
            first, count = (0, 7) if frame.payload[0] == 0x40 else (7, 5)
            board = BOARDS.index(frame.identifier >> 4 & 0xF)
            found[board, frame.identifier & 0xF, first : first + count] = list(frame.payload[1 : 1 + count])
    return 240 - found


def streaming(**options: Any) -> Rig:
    rig = Rig(boards=BOARDS, **{"pattern": "idle"} | options)
    for board in BOARDS:
        rig.configure(board)
    rig.run_ms(200)
    return rig


def places(rig: Rig) -> npt.NDArray[np.float64]:
    """(n_boards, 16, 12, 3)."""
    geometry = rig.hardware.geometry()
    of_pressure = geometry[geometry.type_name == "pressure"]
    return of_pressure.position_m.reshape(len(BOARDS), 16, 12, 3)


def pressing(
    at: npt.NDArray[np.float64], force_n: float = 3.0, radius_m: float = 0.0, seconds: float = 1.0
) -> Pressing:
    return Pressing.of(at.tolist(), force_n, radius_m, seconds)


@pytest.mark.parametrize(("board", "triangle", "channel"), [(0, 0, 0), (1, 9, 11), (2, 15, 3), (3, 2, 5), (3, 12, 8)])
def test_frames_show_a_press_where_it_is(board: int, triangle: int, channel: int) -> None:
    rig = streaming()
    at = places(rig)[board, triangle, channel]
    nearest = rig.hardware.press(pressing(at), rig.now_ns)
    assert nearest == {"board": BOARDS[board], "triangle": triangle, "channel": channel, "distance_m": 0}
    values = felt(rig, 500)[:, :, TACTILE]
    distance = np.linalg.norm(places(rig)[:, :, TACTILE] - at, axis=-1)
    expected = 3 * 24 * np.exp(-0.5 * (distance / 0.004) ** 2)
    assert abs(values - expected).max() <= 4
    assert abs(felt(rig, 700)[:, :, TACTILE]).max() <= 3  # let go


def test_a_press_across_a_fold_is_felt_by_both_boards() -> None:
    rig = streaming()
    all_places = places(rig)[:, :, TACTILE]
    distance = np.linalg.norm(all_places[0].reshape(-1, 1, 3) - all_places[1].reshape(1, -1, 3), axis=-1)
    one, other = np.unravel_index(int(distance.argmin()), distance.shape)
    between = (all_places[0].reshape(-1, 3)[one] + all_places[1].reshape(-1, 3)[other]) / 2
    rig.hardware.press(pressing(between, force_n=5), rig.now_ns)
    values = felt(rig, 500)[:, :, TACTILE].reshape(len(BOARDS), -1)
    assert min(values[0, one], values[1, other]) > 50


def test_force_radius_and_time_are_as_asked_for() -> None:
    rig = streaming()
    at = places(rig)[0, 8, 3]
    rig.hardware.press(pressing(at, force_n=6, radius_m=0.01, seconds=2), rig.now_ns)
    values, distance = felt(rig, 1500), np.linalg.norm(places(rig) - at, axis=-1)
    within = distance[:, :, TACTILE] < 0.01
    assert within.sum() > 5
    assert abs(values[:, :, TACTILE][within] - 6 * 24).max() <= 4
    assert abs(felt(rig, 700)[:, :, TACTILE]).max() <= 3


def test_presses_add_up_and_thermal_pads_feel_none() -> None:
    rig = streaming()
    at = places(rig)[1, 4, 6]
    for _ in range(2):
        rig.hardware.press(pressing(at, force_n=2, radius_m=0.008, seconds=5), rig.now_ns)
    values = felt(rig, 500)
    assert 2 * 2 * 24 - 4 <= values[1, 4, 3] <= 2 * 2 * 24 + 4
    assert abs(values[1, 4, [6, 10]]).max() <= 20


def test_a_press_is_felt_from_the_next_acquisition_on() -> None:
    rig = streaming()
    at = places(rig)[0, 0, 0]
    rig.hardware.press(pressing(at, seconds=5), rig.now_ns)
    assert felt(rig, 150)[0, 0, 0] > 50  # not only when what was computed ahead is used up


@pytest.mark.thorough
def test_a_board_that_restarts_still_feels_who_presses_but_takes_it_for_nothing() -> None:
    rig = streaming()
    at = places(rig)[0, 0, 0]
    rig.hardware.press(pressing(at, seconds=20), rig.now_ns)
    rig.hardware.restart(7, rig.now_ns)
    rig.run_ms(1000)
    rig.configure(7)
    assert abs(felt(rig, 500)[0, 0, 0]) <= 3
    rig.run_ms(20_000)
    assert felt(rig, 500)[0, 0, 0] < -3


def test_who_presses_is_told_while_he_does() -> None:
    rig = streaming()
    assert rig.hardware.pressing(rig.now_ns) == []
    at = places(rig)[2, 3, 4]
    rig.hardware.press(pressing(at, force_n=2, seconds=1), rig.now_ns)
    ((where, force),) = rig.hardware.pressing(rig.now_ns + 500_000_000)
    assert np.allclose(where, at)
    assert force == pytest.approx(2)
    assert rig.hardware.pressing(rig.now_ns + 1_100_000_000) == []


def test_fingers_are_felt_where_they_are_said_to_be() -> None:
    rig = streaming(pattern="touch")
    tactile = places(rig)[:, :, TACTILE]
    checked = 0
    for _ in range(60):
        values = felt(rig, 200)[:, :, TACTILE]
        told = rig.hardware.pressing(rig.now_ns)
        for where, force in told:
            if force < 4:
                continue
            near = np.linalg.norm(tactile - np.array(where), axis=-1) < 0.005
            checked += int(near.sum())
            assert (values[near] > 50).all()
        for peak in tactile[values > 60]:
            assert min(np.linalg.norm(peak - np.array(where)) for where, _ in told) < 0.02
    assert checked > 50


def test_a_stage_file_presses_instead_of_the_fingers_and_begins_again(tmp_path: Path) -> None:
    file = tmp_path / "stage.toml"
    at = places(streaming())[0, 3, 3].tolist()
    file.write_text(
        f'format = "skinware-stage"\nversion = 1\nrepeat_s = 4.0\n[[push]]\nat_m = {at}\nforce_n = 4.0\n'
        "begin_s = 1.0\nend_s = 2.0\n"
    )
    rig = streaming(pattern="touch", stage=str(file))
    for _ in range(3):
        rig.run_ms((START_NS + 1_400_000_000 - rig.now_ns) / 1e6 % 4000)
        assert felt(rig, 100)[0, 3, 3] > 80
        assert abs(felt(rig, 1000)[:, :, TACTILE]).max() <= 3


def test_a_stage_file_with_a_mistake_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere\.toml"):
        Rig(stage=str(tmp_path / "nowhere.toml"))


def test_nothing_is_pressed_where_there_is_no_skin_and_too_many_presses_are_refused() -> None:
    rig = streaming()
    with pytest.raises(ValueError, match=r"nearest taxel is .* mm away; the skin is between"):
        rig.hardware.press(Pressing((1, 1, 1)), rig.now_ns)
    at = places(rig)[0, 0, 0]
    for _ in range(50):
        rig.hardware.press(pressing(at, seconds=1), rig.now_ns)
    with pytest.raises(ValueError, match="50 presses have not ended yet"):
        rig.hardware.press(pressing(at), rig.now_ns)
    rig.run_ms(1100)
    rig.hardware.press(pressing(at), rig.now_ns)


@pytest.mark.parametrize(
    "numbers",
    [
        ([0, 0], 1, 0, 1),
        ([0, 0, 0, 0], 1, 0, 1),
        ("abc", 1, 0, 1),
        (None, 1, 0, 1),
        ([0, 0, None], 1, 0, 1),
        ([0, 0, "1"], 1, 0, 1),
        ([0, 0, float("nan")], 1, 0, 1),
        ([0, 0, 1e300], 1, 0, 1),
        ([0, 0, True], 1, 0, 1),
        ([0, 0, 0], -1, 0, 1),
        ([0, 0, 0], 1e9, 0, 1),
        ([0, 0, 0], 1, -0.1, 1),
        ([0, 0, 0], 1, 0, 0),
        ([0, 0, 0], 1, 0, float("inf")),
    ],
)
def test_nonsense_is_no_press(numbers: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match="give"):
        Pressing.of(*numbers)


@pytest.mark.parametrize("skin_type", [0, 1])
def test_every_sensor_of_the_driver_has_a_place_on_the_arm(skin_type: int) -> None:
    driver = RoboskinDriver(DriverOptions(boards=(7, 8), skin_type=skin_type))
    structure = assemble([("can0", driver.patches_set_up((7, 8)))], driver.types, driver.dtype).structure
    geometry = structure.placed(Rig(boards=(8, 7)).hardware.geometry()).geometry
    assert geometry is not None
    assert geometry.known.all()
    assert set(geometry.frame) == {"arm"}
    of_board_8 = structure.sensor_uid >> np.uint64(16) == 8
    assert np.array_equal(geometry.position_m[of_board_8].reshape(16, 12, 3), places(streaming())[1])


def test_a_bus_by_name_has_places_if_its_devices_have_and_one_for_tests_has_none() -> None:
    assert isinstance(Rig().hardware, PlacedHardware)
    bus = virtual_bus("", {"boards": "3"})
    assert isinstance(bus, PlacedCanBus)
    assert bus.geometry is not None
    assert len(bus.geometry) == 2 * 192
    assert virtual_bus("xela").geometry is None
    assert virtual_bus("openpatch").geometry is None
    assert VirtualCanBus("", hardware=Rig().hardware).geometry is None


def test_every_address_of_a_board_has_its_own_place() -> None:
    geometry = Rig(boards=tuple(range(1, 15))).hardware.geometry()
    position = geometry.position_m[geometry.type_name == "pressure"]
    assert len(np.unique(position.round(6), axis=0)) == 14 * 192
    assert EmulatedRoboskinOptions().boards == BOARDS
