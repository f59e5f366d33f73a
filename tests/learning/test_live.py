"""Live touch for loops: the sample nearest to the moment, the same sensors at each turn, or an error, or a flag."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverWriter, Status, Structure
from skinware.errors import ConfigurationError, ServiceTimeout
from skinware.learning.features import Totals, points
from skinware.learning.images import LiveImage
from skinware.learning.live import ChosenSensors, LiveTouch, TouchOptions
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.sensor_types import FORCE, PRESSURE, SensorType
from skinware.skin_layout import SkinLayout
from skinware.tactile.contacts_service import ContactsWriter
from tests.tactile.skins import AT_ONCE, placed

MS = 1_000_000


def hand(types: tuple[SensorType, ...] = (PRESSURE.measured(unit="N", maximum=10.0),)) -> Structure:
    """A thumb of 2 x 3 taxels and an index finger of 3 x 3, of one or several types."""
    module = np.repeat([0, 1], [6, 9])
    return Structure(
        types=types,
        buses=["x"],
        patch_name=["hand"],
        patch_bus=[0],
        module_patch=[0, 0],
        module_kind=["2x3", "3x3"],
        module_name=["thumb tip", "index tip"],
        sensor_uid=np.tile(np.arange(15), len(types)),
        sensor_type=np.repeat([each.id for each in types], 15),
        sensor_module=np.tile(module, len(types)),
        dtype="<f4",
    )


def publish(writer: DriverWriter, values: object, time_ns: int, status: int = 0) -> None:
    columns = writer.begin()
    columns["values"][:] = values
    columns["status"][:] = status
    columns["module_time_ns"][:] = time_ns
    writer.commit(time_ns)


def test_it_is_the_sample_nearest_to_the_moment() -> None:
    start_ns = now_ns() - 60 * MS
    with DriverWriter("hand", hand(), rate_hz=50, slots=8) as writer:
        for step in range(3):
            publish(writer, step, start_ns + 20 * MS * step)
        with LiveTouch() as live:
            for after_ms, expected in ((1, 0), (9, 0), (11, 1), (29, 1), (31, 2), (45, 2)):
                touch = live.at(start_ns + after_ms * MS)
                assert (touch.values == expected).all()
                assert touch.off_s == pytest.approx((20 * expected - after_ms) / 1000)
                assert not touch.is_held


def test_a_sample_to_come_that_is_nearer_is_waited_for() -> None:
    with DriverWriter("hand", hand(), rate_hz=2, slots=8) as writer:
        publish(writer, 1, now_ns() - 300 * MS)
        with LiveTouch() as live:
            moment_ns = now_ns()
            later = threading.Timer(0.05, publish, (writer, 2, moment_ns + 10 * MS))
            later.start()
            assert (live.at(moment_ns).values == 2).all()
            later.join()


def test_a_dead_driver_raises_and_one_that_returns_goes_on() -> None:
    live, begin_ns = LiveTouch(), now_ns()
    with pytest.raises(ConfigurationError, match="before it was opened"):
        live.now()
    with pytest.raises(ServiceTimeout, match="no driver"):
        live.open(timeout_s=0.0)
    with pytest.raises(ServiceTimeout, match="no driver"):
        LiveTouch(drivers=["foot"]).open(timeout_s=0.0)
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        publish(writer, 1, begin_ns)
        live.open()
        assert (live.at(begin_ns).values == 1).all()
    with pytest.raises(ServiceTimeout, match="no driver"):
        live.now()
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        publish(writer, 2, begin_ns)
        live._skin.refresh()  # type: ignore[union-attr]  # which looks five times a second
        assert (live.at(begin_ns).values == 2).all()
    with DriverWriter("hand", hand((PRESSURE.measured(unit="Pa"),)), rate_hz=50) as writer:
        publish(writer, 3, now_ns())
        live._skin.refresh()  # type: ignore[union-attr]
        with pytest.raises(ServiceTimeout, match="other sensors: open again"):
            live.now()
    live.close()
    assert not live.is_open


def test_a_silent_driver_raises_or_is_held() -> None:
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        begin_ns = now_ns() - 1000 * MS
        publish(writer, 1, begin_ns)
        with LiveTouch(when_stale="hold") as hold, LiveTouch() as strict, LiveTouch(max_age_s=9) as patient:
            first = hold.at(begin_ns + MS)
            held = hold.at(begin_ns + 310 * MS)
            assert (held.is_held, held.values is first.values) == (True, True)
            with pytest.raises(ServiceTimeout, match=r"data is too old: hand \(0\.31 s"):
                strict.at(begin_ns + 310 * MS)
            assert (patient.at(begin_ns + 310 * MS).values == 1).all()
            publish(writer, 2, begin_ns + 320 * MS)
            assert not hold.at(begin_ns + 321 * MS).is_held


def test_bad_values_are_zero_and_not_fresh() -> None:
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        begin_ns = now_ns()
        publish(writer, 4, begin_ns, Status.STALE)
        with LiveTouch() as live:
            touch = live.at(begin_ns)
            assert not touch.fresh.any()
            assert (touch.values == 0).all()


def test_another_driver_that_begins_changes_nothing() -> None:
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        begin_ns = now_ns()
        publish(writer, 1, begin_ns)
        with LiveTouch() as live, DriverWriter("foot", hand(), rate_hz=50) as foot:
            publish(foot, 2, begin_ns)
            assert live.at(begin_ns).values.tolist() == [1.0] * 15


def test_sensors_are_chosen_by_module_patch_or_region(tmp_path: Path) -> None:
    layout = SkinLayout(("hand",), (hand(),))
    assert ChosenSensors(modules=["hand, index tip"]).of(layout).tolist() == list(range(6, 15))
    assert ChosenSensors(modules=["hand"]).of(layout).tolist() == list(range(15))
    with pytest.raises(
        ConfigurationError, match=r"no pressure sensors in 'tip'; modules: hand, index tip; hand, thumb"
    ):
        ChosenSensors(modules=["tip"]).of(layout)
    file = tmp_path / "hand.regions.toml"
    file.write_text('format = "skinware-regions"\nversion = 1\n[[region]]\nname = "corner"\nuid = [0, 14]\n')
    assert ChosenSensors(modules=["corner"], regions=file).of(layout).tolist() == [0, 14]


def test_numbers_have_names_and_are_sums_and_peaks() -> None:
    layout = SkinLayout(("hand",), (hand(),))
    positions = np.arange(2, 15)
    totals = Totals(layout, "pressure", positions)
    assert totals.names == ("hand.thumb_tip.sum", "hand.thumb_tip.peak", "hand.index_tip.sum", "hand.index_tip.peak")
    values = np.arange(13.0)
    assert totals.of(values).tolist() == [6.0, 3.0, 72.0, 12.0]
    each = Totals(layout, "pressure", positions, "taxel")
    assert each.names[0] == "hand.thumb_tip.taxel_2"
    assert each.of(values).tolist() == values.tolist()
    assert Totals(layout, "pressure", positions[:0]).names == ()


def test_points_have_places_and_force_against_the_normal() -> None:
    geometry = placed(np.column_stack([np.arange(15) * 0.01, np.zeros(15), np.zeros(15)]))
    geometry.normal[:] = 0, 0.6, 0.8
    layout = SkinLayout(("hand",), (hand().placed(geometry),))
    found = points(layout, np.array([2.0, 3.0]), "pressure", np.array([4, 7]))
    assert found.dtype == np.float32
    assert np.allclose(found[:, 0], [0.04, 0.07])
    assert np.allclose(found[:, 3:], -np.array([[2.0], [3.0]]) * geometry.normal[[4, 7]])
    unplaced = points(SkinLayout(("hand",), (hand(),)), np.ones(1), "pressure", np.array([4]))
    assert (unplaced == 0).all()


def test_points_are_numbers_with_names() -> None:
    layout = SkinLayout(("hand",), (hand(),))
    totals = Totals(layout, "pressure", np.array([4, 7]), "point")
    assert totals.names[5:8] == ("hand.thumb_tip.taxel_4.fz", "hand.index_tip.taxel_1.x", "hand.index_tip.taxel_1.y")
    assert totals.of(np.array([2.0, 3.0])).shape == (12,)


def test_newer_touch_is_waited_for_and_comes_once() -> None:
    with DriverWriter("hand", hand(), rate_hz=2) as writer:
        publish(writer, 1, now_ns())
        with LiveTouch() as live, LiveTouch(when_stale="hold", max_age_s=0.0) as hold:
            assert (live.newer(timeout_s=0.0).values == 1).all()
            with pytest.raises(ServiceTimeout, match=r"no newer touch within 0\.01 s"):
                live.newer(timeout_s=0.01)
            later = threading.Timer(0.05, lambda: publish(writer, 2, now_ns()))
            later.start()
            assert (live.newer(timeout_s=10.0).values == 2).all()
            later.join()
            with pytest.raises(ServiceTimeout, match="too old"):
                hold.newer(timeout_s=0.0)  # it holds nothing yet
    with pytest.raises(ConfigurationError, match="before it was opened"):
        live.newer(timeout_s=0.0)


def test_contacts_come_with_the_touch_and_are_an_image(namespace: Namespace) -> None:
    structure, begin_ns = hand(), now_ns()
    with (
        DriverWriter("hand", structure, rate_hz=50) as driver,
        ContactsWriter(structure, driver="hand", tracking=AT_ONCE) as contacts,
    ):
        publish(driver, 1, begin_ns)
        touched = np.zeros(15, bool)
        options = TouchOptions(contacts_namespace=namespace.name, max_age_ms=9_000)
        live = LiveImage(options.touch(with_contacts=True), 16, 32, lowest=0, highest=10, shows="contacts")
        contacts.publish(np.full(15, 2.0), touched, begin_ns)
        live.open()
        image, touch = live.at(begin_ns)
        assert touch.contacts is not None
        assert (len(touch.contacts.contacts), int(image.max())) == (0, 0)
        touched[[6, 7]] = True
        contacts.publish(np.full(15, 2.0), touched, begin_ns + MS)
        image, touch = live.at(begin_ns + MS)
        assert touch.contacts is not None
        assert touch.contacts.contacts.load.tolist() == [4.0]
        assert sorted(set(image.ravel().tolist())) == [0, 102]  # 4 of 10, on those two taxels
        live.close()
        with LiveTouch(max_age_s=0.5, contacts_in=namespace) as strict:
            publish(driver, 1, begin_ns + 1000 * MS)
            with pytest.raises(ServiceTimeout, match=r"too old: contacts \(1\.00 s\)"):
                strict.at(begin_ns + 1001 * MS)


def test_options_are_checked() -> None:
    TouchOptions().check()
    with pytest.raises(ValueError, match="when_stale is 'wait': give one of raise, hold"):
        TouchOptions(when_stale="wait").check()


def test_a_live_image_shows_the_touch_of_its_moment() -> None:
    begin_ns = now_ns()
    with DriverWriter("hand", hand(), rate_hz=50) as writer, DriverWriter("foot", hand((PRESSURE,))) as foot:
        columns = np.zeros(15)
        columns[3] = 10.0
        publish(writer, columns, begin_ns)
        publish(foot, 0, begin_ns)
        without_range = LiveImage(LiveTouch(drivers=["foot"]), 16, 32)
        with pytest.raises(ConfigurationError, match="give a finite range"):
            without_range.open()
        assert not without_range.touch.is_open
        live = LiveImage(LiveTouch(drivers=["hand"]), 16, 32, lowest=0).open()
        image, touch = live.at(begin_ns)
        assert image.shape == (16, 32, 3)
        assert image.dtype == np.uint8
        lit = np.argwhere(image[..., 0] == 255)
        assert np.ptp(lit, axis=0).tolist() == [7, 4]  # the second row of two, the first column of three
        assert (int(image.sum()), float(touch.values[3])) == (len(lit) * 3 * 255, 10.0)
        live.close()


def test_shear_is_colour() -> None:
    begin_ns = now_ns()
    types = tuple(each.measured(minimum=-5.0, maximum=5.0) for each in FORCE)
    with DriverWriter("hand", hand(types), rate_hz=50) as writer:
        publish(writer, np.repeat([5.0, -5.0, 2.5], 15), begin_ns)
        live = LiveImage(LiveTouch(ChosenSensors("force_z")), 8, 16, "shear").open()
        image, _ = live.at(begin_ns)
        assert {tuple(pixel) for pixel in image.reshape(-1, 3).tolist()} == {(0, 0, 0), (255, 1, 128)}
        live.close()
    with DriverWriter("hand", hand(types).only(np.arange(40)), rate_hz=50) as writer:
        publish(writer, 0, begin_ns)
        live = LiveImage(LiveTouch(ChosenSensors("force_z")), 8, 16, "shear")
        with pytest.raises(ConfigurationError, match="not of the same taxels"):
            live.open()
