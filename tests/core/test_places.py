"""Places of sensors: published by drivers, read by programs, in the order of their values."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin, Structure
from skinware.errors import StructureError
from skinware.geometry import Geometry, GeometryGroup, geometry_to_toml, read_geometry
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import fake_structure
from tests.commands import run, running
from tests.core.test_snapshot import publish, skin_of

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "skin.md"


def some_places(tmp_path: Path, *uid: int, type_name: str = "pressure") -> Path:
    path = tmp_path / "places.toml"
    positions = tuple((u / 1000, -2.0, 1e-9) for u in uid)
    group = GeometryGroup(type_name, "chest", uid, positions, ((0.0, 0.0, 1.0),) * len(uid), 0.002)
    path.write_text(geometry_to_toml([group]))
    return path


def test_places_are_published_with_the_structure(tmp_path: Path) -> None:
    placed = fake_structure(1, 2).placed(read_geometry(some_places(tmp_path, 1003, 1005)))
    with DriverWriter("arm", placed) as arm, DriverWriter("leg", fake_structure(1, 1)) as leg:
        publish(arm, 1)
        publish(leg, 1)
        with skin_of("arm", "leg") as skin:
            places = skin.geometry("pressure")
            assert len(places) == 30
            assert np.flatnonzero(places.known).tolist() == [3, 5]
            assert places.position_m[[3, 5]].tolist() == [[1.003, -2.0, 1e-9], [1.005, -2.0, 1e-9]]
            assert places.normal[5].tolist() == [0, 0, 1]
            assert places.radius_m[3] == 0.002
            assert places.frame[[3, 4, 29]].tolist() == ["chest", "", ""]
            assert places.uid.tolist() == skin.layout.uids("pressure").tolist()
            assert not skin.geometry("temperature").known.any()
            assert skin.read().layout.structures[0] == placed
            with pytest.raises(StructureError, match="no sensor type 'heat'"):
                skin.geometry("heat")
    with Skin() as skin, pytest.raises(StructureError, match="no driver runs"):
        skin.geometry("pressure")


def test_places_belong_to_what_makes_structures_equal(tmp_path: Path) -> None:
    bare = fake_structure(1, 2)
    placed = bare.placed(read_geometry(some_places(tmp_path, 1003)))
    assert placed == bare.placed(read_geometry(some_places(tmp_path, 1003)))  # with NaN in both
    assert placed != bare
    assert bare != placed
    assert placed != bare.placed(read_geometry(some_places(tmp_path, 1004)))
    assert placed.replace(buses=["can7"]).geometry is placed.geometry


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("sensor_position_m", np.zeros(23)),
        ("sensor_normal", np.zeros(72, "<f4")),
        ("sensor_radius_m", None),
        ("sensor_frame", np.full(24, 7, "<u4")),
        ("frame_name", None),
    ],
)
def test_damaged_places_are_refused(name: str, column: np.ndarray | None, tmp_path: Path) -> None:
    columns = fake_structure(1, 2).placed(read_geometry(some_places(tmp_path, 1003))).to_columns()
    del columns[name]
    if column is not None:
        columns[name] = column
    with pytest.raises(StructureError, match=r"sensor_|frame"):
        Structure.from_columns(columns, "u1")


def test_places_of_another_number_of_sensors_are_refused() -> None:
    with pytest.raises(StructureError, match="places of 1 sensors, for 24"):
        fake_structure(1, 2).replace(geometry=Geometry.unknown(["pressure"], np.array([1000], np.uint64)))


@pytest.mark.thorough
def test_a_driver_publishes_the_file_that_its_configuration_names(tmp_path: Path) -> None:
    (text,) = re.findall(r"^```toml\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "torso.geometry.toml").write_text(text)
    config = tmp_path / "torso.toml"
    config.write_text('name = "torso"\ngeometry = "torso.geometry.toml"\n[[bus]]\nname = "virtual?boards=8"\n')
    with running("skin-driver", "--config", str(config)) as driver:
        driver.wait_for("ready")
        with Skin(drivers=["torso"]) as skin:
            skin.read(timeout_s=60)
            places = skin.geometry("pressure")
            assert places.uid[places.known].tolist() == [0x80500, 0x80501]
            assert places.position_m[places.known].tolist() == [[0.01, 0.02, 0.03], [0.01, 0.03, 0.03]]
        driver.process.send_signal(signal.SIGINT)


@pytest.mark.thorough
@pytest.mark.parametrize("by", ["--config", "--geometry"])
def test_a_running_driver_reads_its_file_again(tmp_path: Path, by: str) -> None:
    places, config = some_places(tmp_path, 0x80500), tmp_path / "torso.toml"
    unnamed = '[[bus]]\nname = "virtual?boards=8"\n'
    named = f'geometry = "{places.name}"\n{unnamed}'
    config.write_text(named)
    arguments = ["--config", config] if by == "--config" else ["--bus", "virtual?boards=8", "--geometry", places]

    def known(skin: Skin) -> list[int]:
        skin.read(timeout_s=60)
        skin.refresh()
        geometry = skin.geometry("pressure")
        return [int(uid) for uid in geometry.uid[geometry.known]]

    with running("skin-driver", *map(str, arguments)) as driver, Skin() as skin:
        driver.wait_for("ready")
        assert known(skin) == [0x80500]
        with DriverReader("roboskin") as reader:
            generation = reader.generation
            driver.process.send_signal(signal.SIGHUP)  # nothing has changed
            good = places.read_text()
            places.write_text(good.replace("normal = [", "normal = [\n  [0.0, 2.0, 0.0],"))
            driver.process.send_signal(signal.SIGHUP)
            wait_until(lambda: f"places stay as they are: {places}:4: 1 uid, but 2 normal" in driver.errors)
            assert reader.read().generation == reader.refresh()[0] == generation  # type: ignore[index]
        some_places(tmp_path, 0x80500, 0x80501)
        driver.process.send_signal(signal.SIGHUP)
        wait_until(lambda: known(skin) == [0x80500, 0x80501])
        if by == "--config":
            config.write_text(unnamed)
            driver.process.send_signal(signal.SIGHUP)
            wait_until(lambda: len(known(skin)) == 160)  # all, as the emulated boards lie
        driver.process.send_signal(signal.SIGINT)


@pytest.mark.thorough
def test_a_file_of_another_skin_or_none_is_told_of(tmp_path: Path) -> None:
    foreign = some_places(tmp_path, 5, type_name="heat")
    with running("skin-driver", "--bus", "virtual?boards=8", "--geometry", str(foreign)) as driver:
        driver.wait_for("ready")
        assert "the geometry has no place for any of the sensors" in driver.errors
        driver.process.send_signal(signal.SIGINT)
    missing = run("skin-driver", "--bus", "virtual", "--geometry", str(tmp_path / "none.toml"))
    assert (missing.returncode, "none.toml: No such file" in missing.stderr) == (2, True)
