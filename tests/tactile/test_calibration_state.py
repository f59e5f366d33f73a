"""What was gathered survives an interruption, and files that do not fit are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.state import PressSession, Session, StrokeSession, restore_session, save_session

UID = np.arange(4, dtype=np.uint64) + 7
PERIOD_NS = 20_000_000


def press(session: Session, load: list[float], pose: np.ndarray | None) -> None:
    for number in range(12):
        session.take(number * PERIOD_NS, np.array(load), pose)
    session.take(13 * PERIOD_NS, np.zeros(4), pose)


def test_presses_go_on(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    session = PressSession(4, wanted=2)
    assert not restore_session(file, session, "pressure", UID)
    press(session, [9, 1, 0, 0], np.zeros(3))
    press(session, [0, 0, 9, 8], np.ones(3))
    save_session(file, session, "pressure", UID)
    again = PressSession(4, wanted=2)
    assert restore_session(file, again, "pressure", UID)
    assert again.figures == session.figures == {"presses": 2}
    assert again.coverage.tolist() == [0.5, 0, 0.5, 0.5]
    press(again, [9, 9, 9, 9], np.ones(3) / 2)
    assert again.coverage.tolist() == [1, 0.5, 1, 1]
    assert again.is_complete(0.75)
    assert not again.is_complete(0.95)
    assert not list(tmp_path.glob(".*"))


def test_strokes_go_on(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    loads = np.random.default_rng(1).random((50, 4))
    whole, first = StrokeSession(4), StrokeSession(4)
    for number, load in enumerate(loads):
        whole.take(number, load, None)
        if number < 30:
            first.take(number, load, None)
    save_session(file, first, "pressure", UID)
    again = StrokeSession(4)
    assert restore_session(file, again, "pressure", UID)
    for number in range(30, 50):
        again.take(number, loads[number], None)
    assert np.allclose(again.sums.products, whole.sums.products)
    assert again.figures == whole.figures == {"frames": 50}
    assert again.is_complete(1.0)


def test_a_state_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    session = PressSession(4)
    press(session, [9, 1, 0, 0], np.zeros(3))
    save_session(file, session, "pressure", UID)
    for other, type_name, uid, why in (
        (StrokeSession(4), "pressure", UID, "has points"),
        (PressSession(4, pose_shape=(4, 4)), "pressure", UID, "has points"),
        (PressSession(4), "force", UID, "other sensors"),
        (PressSession(4), "pressure", UID[::-1].copy(), "other sensors"),
    ):
        with pytest.raises(ConfigurationError, match=why):
            restore_session(file, other, type_name, uid)
    whole = file.read_bytes()
    for bad in (b"", b"nothing", whole[: len(whole) // 2]):
        file.write_bytes(bad)
        with pytest.raises(ConfigurationError, match=r"state\.npz cannot be read"):
            restore_session(file, PressSession(4), "pressure", UID)
    np.savez(file, version=np.array(1))
    with pytest.raises(ConfigurationError, match="another version"):
        restore_session(file, PressSession(4), "pressure", UID)
