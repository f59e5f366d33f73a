"""Forces from taxels with hysteresis, creep and a temperature: the fit, its file, its stage, and what it doubts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.force import ForceData, ForceFit, fit_force
from skinware.tactile.calibration.state import ForceSession, restore_session, save_session
from skinware.tactile.contacts import Contacts
from skinware.tactile.curves import CurveTable, curves_to_toml, read_curves

TAXELS, RATE_HZ, REACH_N = 4, 20, 5.0
UID = np.arange(TAXELS, dtype=np.uint64) + 7


def pressed(seed: int, seconds: float = 480.0) -> ForceData:
    """Presses of 0.3 to 5 N, shared by four taxels with gains of their own.

    Readings lag by half a newton of play (a tenth of it counts), creep by 10 % in 25 s, bend as a power of 0.85, and
    change by 0.4 % a kelvin, over 12 K; noise 0.8 counts, steps of 1.
    """
    random = np.random.default_rng([seed, 99])
    m = int(seconds * RATE_HZ)
    time_s = np.arange(m) / RATE_HZ
    force_n = np.zeros((m, TAXELS))
    at_s = 2.0
    while at_s < seconds - 12:
        rows = np.arange(int(at_s * RATE_HZ), int((at_s + random.uniform(3, 9)) * RATE_HZ))
        ramp = np.minimum(rows - rows[0], rows[-1] - rows) / (random.uniform(0.3, 2) * RATE_HZ)
        share = random.dirichlet(np.full(TAXELS, 0.5))
        force_n[rows] = random.uniform(0.3, REACH_N) * np.minimum(ramp, 1)[:, None] * share
        at_s = rows[-1] / RATE_HZ + random.uniform(0.5, 2)
    gain = np.clip(1 + 0.2 * random.standard_normal(TAXELS), 0.5, 1.6)
    temperature_c = 25 + 6 * np.sin(time_s / 20 + seed)
    follows, slow, load = np.zeros(TAXELS), np.zeros(TAXELS), np.zeros((m, TAXELS))
    for row, now in enumerate(force_n):
        follows = np.where(now > 0, np.clip(follows, now - 0.5, now + 0.5), 0)
        slow += (now - slow) / RATE_HZ / 25
        felt = np.maximum(now + 0.1 * (follows - now) + 0.1 * slow, 0)
        load[row] = 40 * gain * felt**0.85 * (1 + 0.004 * (temperature_c[row] - 25))
    load = np.rint(load + 0.8 * random.standard_normal(load.shape))
    load[(load < 3) | (force_n <= 0)] = 0
    return ForceData(time_s, load, force_n.sum(axis=1), temperature_c)


def part(data: ForceData, rows: slice) -> ForceData:
    return ForceData(data.time_s[rows], data.load[rows], data.force_n[rows], data.temperature_c[rows])


def applied(fit: ForceFit, data: ForceData) -> tuple[np.ndarray, np.ndarray]:
    """(m,) forces and (m,) their standard deviations, as a chain and its contacts add them up."""
    table = CurveTable(fit.curves(UID), "pressure", UID)
    forces, errors = np.zeros(len(data.time_s)), np.zeros(len(data.time_s))
    for row, values in enumerate(data.load.astype(np.float32)):
        found = table.step(values, 1 / RATE_HZ, data.temperature_c[row])
        forces[row], errors[row] = found.sum(), table.error(values, found)[values > 0].sum()
    return forces, errors


@pytest.mark.thorough
@pytest.mark.parametrize("seeds", [range(4)])
def test_forces_and_their_intervals(seeds: range) -> None:
    """The second half of each session is unseen by the fit; errors within 10 %, 95 % intervals hold 90 to 98 %."""
    held = []
    for seed in seeds:
        data = pressed(seed)
        half = len(data.time_s) // 2
        fit = fit_force(part(data, slice(half)))
        unseen = part(data, slice(half, None))
        forces, errors = applied(fit, unseen)
        on = unseen.force_n > 0.3
        left = np.abs(forces - unseen.force_n)[on]
        assert not fit.doubts
        assert np.sqrt((left**2).mean()) < 0.1 * REACH_N
        assert np.median(left / unseen.force_n[on]) < 0.1
        known = np.isfinite(errors[on])
        held.append(float((left <= 1.96 * errors[on])[known].mean()))
    assert 0.9 <= np.mean(held) <= 0.98, held


def test_a_file_of_curves_comes_back(tmp_path: Path) -> None:
    fit = fit_force(pressed(1, 120.0))
    path = tmp_path / "curves.toml"
    path.write_text(curves_to_toml(fit.curves(UID), "of a test\nin two lines"))
    assert read_curves(path) == fit.curves(UID)
    assert path.read_text().startswith("# of a test\n# in two lines\nformat")


def test_forces_that_do_not_follow_the_reference_are_doubted() -> None:
    data = pressed(2, 120.0)
    other = ForceData(data.time_s, data.load, pressed(3, 120.0).force_n, data.temperature_c)
    (doubt, *_) = fit_force(other).doubts
    assert doubt.startswith("it misses the reference by ")


def test_a_few_weights_give_curves_and_are_doubted() -> None:
    """Taxels that are always pressed together have any gains that fit: none of them falls."""
    weight_n = np.repeat([1.0, 3.0, 6.0], 100)
    time_s = np.arange(300) / RATE_HZ + 20 * np.repeat([0, 1, 2], 100)
    random = np.random.default_rng(1)
    load = np.rint(np.outer(weight_n, [20, 19, 1, 2]) + random.standard_normal((300, 4))).clip(0)
    fit = fit_force(ForceData(time_s, load, weight_n, np.full(300, np.nan)))
    assert len(fit.curves(UID)) == 1 + TAXELS
    assert np.nanmin(fit.gain) >= 0.1
    assert fit.presses == 3
    assert any(doubt.startswith("3 presses") for doubt in fit.doubts)


def test_beyond_the_knots_the_uncertainty_is_not_known() -> None:
    table = CurveTable(fit_force(pressed(1, 120.0)).curves(UID), "pressure", UID)
    values = np.array([10, 10, 10, 1e4], np.float32)
    assert np.isfinite(table.error(values, table.step(values, 0.05))).tolist() == [True, True, True, False]


def test_too_little_is_refused() -> None:
    data = pressed(1, 120.0)
    for wrong in (part(data, slice(60)), ForceData(data.time_s, 0 * data.load, data.force_n, data.temperature_c)):
        with pytest.raises(ConfigurationError, match="frames with a load: give 200"):
            fit_force(wrong)


def test_a_session_goes_on(tmp_path: Path) -> None:
    file, session = tmp_path / "state.npz", ForceSession(TAXELS)
    for number in range(120):
        session.take(number * 50_000_000, np.array([3.0, 0, np.nan, 5]), np.array([1.5, 25.0]))
    session.take(0, np.zeros(TAXELS), None)
    save_session(file, session, "pressure", UID)
    again = ForceSession(TAXELS)
    assert restore_session(file, again, "pressure", UID)
    assert again.figures == {"frames": 120}
    assert again.coverage.tolist() == [1, 0, 0, 1]
    for name in ("time_s", "load", "force_n", "temperature_c"):
        assert np.array_equal(getattr(again.data, name), getattr(session.data, name))


def test_contacts_of_newtons_have_forces() -> None:
    contacts = Contacts(3, np.array([[1, -1], [0, 2], [1, -1]]), unit="N")
    for number in range(5):
        given = np.array([0.5, 1.0, 0]), np.array([True, True, False]), number * 20_000_000
        found = contacts.update(*given, uncertainty=np.full(3, 0.1))
    assert found.force_n.tolist() == [1.5]
    assert found.uncertainty == pytest.approx([0.2])
