"""The service of motion beside a calmed driver."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware import Namespace, ServiceWriter
from skinware.errors import BadServiceFile, ConfigurationError
from skinware.tactile.motion import COLUMNS, MotionReader, MotionWriter
from skinware.tactile.regions import Region, Regions
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import running
from tests.tactile.reading import read_until
from tests.tactile.test_calm_contacts import calming, placed_structure, press, tare

REGIONS = Regions(
    [
        Region("first", patch=("board 7",)),
        Region("second", "pressure", patch=("board 8",)),
        Region("elsewhere", driver=("leg",), patch=("board 7",)),
        Region("warmth", "temperature", patch=("board 7",)),
    ]
)
FILE = """\
format = "skinware-regions"
version = 1
[[region]]
name = "first"
patch = ["board 7"]
"""


@pytest.fixture
def into(calm_namespace: Namespace) -> Namespace:
    return calm_namespace


def test_regions_of_the_driver_are_told(into: Namespace) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin), calming(into, regions=REGIONS):
        with MotionReader(namespace=into, timeout_s=10) as motion:
            source = motion.source
            assert source.regions == ("first", "second", "elsewhere")
            assert (source.driver, source.type_name, source.unit, source.frames) == (
                "fake",
                "pressure",
                "counts",
                ("palm",),
            )
            tare(into)
            press(skin, 22, 23, 78)
            frame = read_until(motion, lambda frame: bool(frame.motion.contacts.sum() == 2))
            first, second, elsewhere = frame
            assert (first.name, first.load, first.contacts, first.frame) == ("first", 100, 1, "palm")
            assert (second.load, elsewhere.contacts) == (50, 0)
            press(skin, 23, 24, 78)
            frame = read_until(motion, lambda frame: bool(frame.motion.speed_m_s[0] > 0))
            assert frame.motion[0].direction == pytest.approx([1, 0, 0], abs=1e-3)


def test_another_structure_and_no_regions_in_it(into: Namespace, caplog: pytest.LogCaptureFixture) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    only = Regions([Region("warmth", "temperature", patch=("board 7",))])
    with publishing(skin), calming(into, regions=only):
        assert "no motion of 'fake': no region is of pressure sensors" in caplog.text
        assert sorted(into.services()) == ["contacts", "fake", "health"]


def test_a_name_that_another_program_has(into: Namespace, caplog: pytest.LogCaptureFixture) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin), MotionWriter(skin.structure, "pressure", REGIONS, (), namespace=into):
        with calming(into, regions=REGIONS):
            assert "fake-motion" in into.services()
        with calming(into, regions=REGIONS, motion="mine"):
            assert "mine" in into.services()
        with (
            MotionWriter(skin.structure, "pressure", REGIONS, (), name="fake-motion", namespace=into),
            calming(into, regions=REGIONS),
        ):
            assert "no motion of 'fake': " in caplog.text


@pytest.mark.thorough
def test_the_command_takes_files_of_regions(into: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    file = tmp_path / "parts.toml"
    file.write_text(FILE)
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin):
        with running("skin-calm", "fake", "--into", into.name, "--regions", str(file), "--motion", "ways") as command:
            assert command.wait_for("ready")["motion"] == "ways"
            with MotionReader("ways", namespace=into, timeout_s=10) as motion:
                assert motion.source.regions == ("first",)
        with running("skin-calm", "fake", "--into", into.name) as command:
            assert command.wait_for("ready")["motion"] == ""


def test_services_of_another_kind_or_form_are_refused(into: Namespace) -> None:
    columns = {name: (dtype, (2, *shape)) for name, (dtype, shape, *_) in COLUMNS.items()}
    static = {
        "region_name": np.array([b"one", b"two"]),
        "frame_name": np.array([b"palm"]),
        "driver": np.array([b"fake"]),
        "type_name": np.array([b"pressure"]),
        "type_unit": np.array([b"counts"]),
    }
    for kind, given, beside in (
        ("data", columns, static),
        ("motion", columns | {"load": ("<f8", (2,))}, static),
        ("motion", columns | {"frame": ("<i2", (3,))}, static),
        ("motion", columns, {name: static[name] for name in ("region_name", "driver")}),
    ):
        with ServiceWriter("odd", given, beside, namespace=into, kind=kind), pytest.raises(BadServiceFile):
            MotionReader("odd", namespace=into)
    with ServiceWriter("fine", columns, static, namespace=into, kind="motion"):
        with MotionReader("fine", namespace=into) as reader:
            assert reader.source.regions == ("one", "two")
    with pytest.raises(ConfigurationError, match="no region is of pressure sensors"):
        MotionWriter(fake_structure(), "pressure", Regions([]), ())
