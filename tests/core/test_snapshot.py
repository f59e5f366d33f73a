"""What a snapshot says of the sensors of a type, over several drivers; which drivers take part; one moment for all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import skinware.skin
from skinware import DriverReader, DriverWriter, Skin, Structure
from skinware.errors import ConfigurationError, ServiceTimeout, StructureError
from skinware.realtime import NS_PER_S, now_ns
from skinware.sensor_types import PROXIMITY
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import fake_structure
from tests.core.test_structure import tables

MS = 1_000_000


def publish(writer: DriverWriter, value: float, time_ns: int | None = None) -> None:
    time_ns = now_ns() if time_ns is None else time_ns
    columns = writer.begin()
    columns["values"][:] = value
    columns["status"][:] = 0
    columns["module_time_ns"][:] = time_ns
    writer.commit(time_ns)


def skin_of(*drivers: str) -> Skin:
    skin = Skin()
    wait_until(lambda: skin.refresh().drivers == drivers)
    return skin


def in_pascal() -> Structure:
    return Structure(**tables(types=[skinware.sensor_types.PRESSURE, skinware.sensor_types.TEMPERATURE]))


def test_frames_and_snapshots_have_one_form() -> None:
    with (
        DriverWriter("arm", fake_structure(1, 2)) as arm,
        DriverWriter("leg", fake_structure(1, 1, dtype="<i2")) as leg,
    ):
        publish(arm, 200)
        publish(leg, -300)
        with skin_of("arm", "leg") as skin:
            snapshot = skin.read()
            assert snapshot.raw("pressure").tolist() == [200] * 20 + [-300] * 10
            assert snapshot.physical("pressure").tolist() == [55.0] * 20 + [555.0] * 10
            assert not snapshot.status_of("temperature").any()
            assert (
                snapshot.time_ns("temperature").tolist()
                == [snapshot.acquired_ns[0]] * 4 + [snapshot.acquired_ns[1]] * 2
            )
            assert snapshot.unit("pressure") == "counts"
            for name in ("raw", "physical", "status_of", "time_ns", "fresh"):
                alone = getattr(snapshot.of("leg"), name)("pressure")
                assert alone.tolist() == getattr(snapshot, name)("pressure")[20:].tolist()
            with pytest.raises(StructureError, match="no driver 'head' in this snapshot; there are: arm, leg"):
                snapshot.of("head")


def test_every_sensor_has_its_patch_and_module_and_a_name_over_all_drivers() -> None:
    with DriverWriter("arm", fake_structure(2, 2)) as arm, DriverWriter("leg", fake_structure(1, 2)) as leg:
        publish(arm, 1)
        publish(leg, 1)
        with skin_of("arm", "leg") as skin:
            snapshot = skin.read()
            layout = snapshot.layout
            assert layout.patches == ("board 7 of arm", "board 8", "board 7 of leg")
            assert layout.modules[1:3] == ("board 7 of arm, triangle 1", "board 8, triangle 0")
            assert layout.modules[4:] == ("board 7 of leg, triangle 0", "board 7 of leg, triangle 1")
            assert snapshot.patch_of("temperature").tolist() == [0] * 4 + [1] * 4 + [2] * 4
            assert snapshot.module_of("pressure").tolist() == np.repeat(np.arange(6), 10).tolist()
            assert layout.sensor_name("pressure", 45) == "board 7 of leg, triangle 0, taxel 5"
            assert layout.sensor_name("temperature", 7) == "board 8, triangle 1, temperature 11"


def test_different_units_are_not_put_into_one_array() -> None:
    with DriverWriter("arm", fake_structure(1, 2)) as arm, DriverWriter("tip", in_pascal()) as tip:
        publish(arm, 1)
        publish(tip, 2)
        with skin_of("arm", "tip") as skin:
            snapshot = skin.read()
            with pytest.raises(StructureError, match=r"pressure comes in different units: counts of arm, Pa of tip;"):
                snapshot.physical("pressure")
            with pytest.raises(StructureError, match=r"snapshot\.of\('arm'\)\.physical\('pressure'\), or choose"):
                snapshot.unit("pressure")
            assert snapshot.of("tip").physical("pressure").tolist() == [2.0, 2.0]
            assert snapshot.fresh("pressure", max_age_s=3600).all()
            assert len(snapshot.physical("temperature")) == 6
        with Skin(drivers=["tip"]) as chosen:
            assert chosen.read(timeout_s=10).unit("pressure") == "Pa"


def test_int32_keeps_all_its_digits() -> None:
    structure = Structure(**tables(types=tables()["types"], dtype="<i4"))
    with DriverWriter("a", structure) as writer, DriverReader("a") as reader:
        publish(writer, 2**24 + 1)
        physical = reader.read().physical("temperature")
        assert physical.dtype == np.float64
        assert physical.tolist() == [2**24 + 1] * 2
    assert Structure(**tables()).physical(np.zeros(4, np.uint8), "pressure").dtype == np.float32


def test_only_chosen_drivers_take_part_and_wake_anybody() -> None:
    structure = fake_structure(1, 1)
    with DriverWriter("fast", structure) as fast, DriverWriter("arm", structure) as arm:
        publish(fast, 1)
        publish(arm, 1)
        with Skin(drivers=["arm", "leg"]) as skin:
            snapshot = skin.read(timeout_s=10)
            assert snapshot.layout.drivers == ("arm",)
            publish(fast, 2)
            with pytest.raises(ServiceTimeout, match="published anything newer: arm"):
                skin.read(newer_than=snapshot, timeout_s=0.3)
    with Skin(drivers=["leg"]) as skin, pytest.raises(ServiceTimeout, match=r"no driver \(leg\) runs"):
        skin.read(timeout_s=0)
    with pytest.raises(ConfigurationError, match=r"give a list of names, as \['arm'\]"):
        Skin(drivers="arm")


def test_drivers_without_the_types_stay_out_until_they_have_them(monkeypatch: pytest.MonkeyPatch) -> None:
    near = Structure(**tables(types=[PROXIMITY], sensor_type=[PROXIMITY.id] * 4, sensor_uid=[1, 2, 3, 4]))
    attached: list[str] = []
    attach = skinware.skin._SkinReader

    def note(name: str, **more: Any) -> Any:
        attached.append(name)
        return attach(name, **more)

    monkeypatch.setattr(skinware.skin, "_SkinReader", note)
    with DriverWriter("near", near) as writer, DriverWriter("arm", fake_structure(1, 1)) as arm:
        publish(writer, 1)
        publish(arm, 1)
        with Skin(types=["pressure", "shear_x"]) as skin:
            assert skin.read(timeout_s=10).layout.drivers == ("arm",)
            for _ in range(3):
                skin.refresh()
            assert attached.count("near") == 1  # it is remembered
            writer.restructure(fake_structure(1, 2))
            publish(writer, 1)
            wait_until(lambda: skin.refresh().drivers == ("arm", "near"))
            writer.restructure(near)
            publish(writer, 1)
            wait_until(lambda: skin.refresh().drivers == ("arm",))


def test_aligned_snapshots_show_one_moment() -> None:
    """A driver of 1 kHz beside one of 50 Hz: the fast one's frame of the slow one's moment, and not its newest."""
    structure, now = fake_structure(1, 1), now_ns()
    with DriverWriter("fast", structure, slots=64) as fast, DriverWriter("slow", structure, rate_hz=0.1) as slow:
        for number in range(40):
            publish(fast, number, now + (number - 40) * MS)
        publish(slow, 1, now - 40 * MS)
        publish(slow, 2, now - 20 * MS + 300_000)
        with skin_of("fast", "slow") as skin:
            newest, aligned = skin.read(), skin.read(align=True)
            assert newest.raw("pressure").tolist() == [39] * 10 + [2] * 10
            assert newest.spread_s == pytest.approx(0.0187)
            assert aligned.raw("pressure").tolist() == [20] * 10 + [2] * 10
            assert aligned.spread_s == pytest.approx(0.0003)
            publish(fast, 41, now + MS // 2)
            with pytest.raises(ServiceTimeout):  # nothing that all have reached is newer
                skin.read(newer_than=aligned, align=True, timeout_s=0.1)
            publish(slow, 3, now)
            assert skin.read(newer_than=aligned, align=True).raw("pressure").tolist() == [41] * 10 + [3] * 10
            assert skin.reader("fast").missed == 0  # an older one, taken later, makes none lost


def test_a_silent_driver_does_not_hold_the_moment_back() -> None:
    structure, now = fake_structure(1, 1), now_ns()
    with DriverWriter("hung", structure) as hung, DriverWriter("arm", structure) as arm:
        publish(hung, 1, now - 5 * NS_PER_S)
        for number in range(3):
            publish(arm, number, now + (number - 3) * MS)
        with skin_of("arm", "hung") as skin:
            snapshot = next(skin.samples(100, align=True))
            assert snapshot.raw("pressure").tolist() == [2] * 10 + [1] * 10
            assert snapshot.spread_s == pytest.approx(4.999)
