"""Three-axis taxels while the hand turns: a field is no touch, and a touch is felt in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from skinware import DriverSnapshot, Status, Structure
from skinware.errors import ConfigurationError
from skinware.sensor_types import MAGNETIC_FIELD
from skinware.tactile.chain import ChainSettings
from skinware.tactile.derived_services import Loads
from skinware.tactile.stages import Taxels
from skinware.tactile.vectors import ArrayField, FieldSettings, vectors_of
from tests.cli.fake_skin import fake_structure
from tests.tactile.turning import Frame, Turning, judge

CHAIN = 'format = "skinware-chain"\nversion = 1\n' + "".join(
    f'[[stage]]\nstage = "{stage}"\n' for stage in ("field", "baseline", "vector")
)


def test_presses_are_felt_and_let_go_while_a_finger_turns() -> None:
    found = judge(Turning("anyskin", seeds=3, until_s=32))
    assert found.false.mean() <= 0.01
    assert found.on.min() >= 0.99
    assert found.wrong.max() <= 0.05
    assert found.left.max() == 0


@pytest.mark.thorough
def test_without_the_field_stage_the_same_world_is_full_of_touches() -> None:
    assert judge(Turning("anyskin", seeds=3, until_s=32), field=False).false.mean() > 0.1


@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.parametrize("kind", ["anyskin", "xela"])
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"press": 20.0},
        {"speed": 5.0},
        {"covered": True},
        {"lost": 0.3},
        {"grip": 0.5},
        {"grip": 1.0},
        {"begin_s": 12.0},
    ],
)
def test_twenty_fingers_turn(kind: str, how: dict[str, Any]) -> None:
    found = judge(Turning(kind, **how))
    assert found.false.mean() <= 0.01
    assert found.on.min() >= 0.99
    assert np.median(found.wrong) <= 0.08
    assert found.left.mean() <= 0.01


def magnetometers(n: int = 8) -> Structure:
    return Structure(
        types=[one.measured(unit="uT") for one in MAGNETIC_FIELD],
        buses=["serial"],
        patch_name=["finger"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=["board"],
        sensor_uid=np.repeat(np.arange(n), 3),
        sensor_type=[one.id for one in MAGNETIC_FIELD] * n,
        sensor_module=np.zeros(3 * n, int),
        dtype=np.float32,
    )


def test_a_chain_takes_the_axes_of_a_driver_together(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text(CHAIN)
    structure = magnetometers()
    chain = ChainSettings.read(path).chain(structure)
    assert [stage.name for stage in chain.stages["magnetic_field_y"]] == ["field", "baseline", "vector"]
    random, values, status = np.random.default_rng(1), np.zeros(24, np.float32), np.zeros(24, np.uint8)
    for number in range(400):
        turned = 20 * np.sin(number / 40 + np.arange(3))
        given = 100 + np.tile(turned, 8) + 0.3 * random.standard_normal(24)
        given[:3] += [3 * (number > 380), 0, 40 * (number > 380)]
        chain.step(
            cast(DriverSnapshot, Frame(structure, number * 20_000_000, given, np.zeros(24, np.uint8))), values, status
        )
    assert values.reshape(8, 3)[0] == pytest.approx([3, 0, 40], abs=2)
    assert not values[3:].any()
    assert not (status & Status.NEVER_SEEN).any()
    loads = Loads.of(chain)
    assert loads is not None
    assert loads.type_name == "magnetic_field_z"
    loads.find()
    assert loads.load[0] == pytest.approx(40.1, abs=2)
    assert np.flatnonzero(loads.touched).tolist() == [0]
    assert loads.more["uncertainty"] is not None
    assert not np.any(loads.more["clipped"])
    chain.flags[1] = Status.STALE
    loads.find()
    assert not loads.touched.any()


def test_a_driver_without_vectors_or_with_few_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text(CHAIN)
    with pytest.raises(ConfigurationError, match="no three types in one unit are the axes"):
        ChainSettings.read(path).chain(fake_structure())
    with pytest.raises(ConfigurationError, match="no patch has 4 taxels of magnetic_field_x"):
        ChainSettings.read(path).chain(magnetometers(3))


def test_axes_have_the_same_taxels_and_unit() -> None:
    structure = magnetometers()
    axes = {one.name: Taxels.of(structure, one.name) for one in structure.types}
    assert vectors_of(axes) == [tuple(axes)]
    assert vectors_of(dict(list(axes.items())[:2])) == []
    fewer = Taxels.of(magnetometers(5), "magnetic_field_z")
    assert vectors_of({**axes, "magnetic_field_z": fewer}) == []
    assert FieldSettings().stage(*axes.values()).taxels.signed


def test_small_patches_pass_and_long_gaps_begin_again() -> None:
    field = ArrayField(np.repeat([0, 1], [3, 5]), 0.1)
    assert len(field) == 1
    random, level = np.random.default_rng(1), np.arange(24.0).reshape(3, 8)
    for number in range(60):
        given = (level + 0.1 * random.standard_normal((3, 8))).astype(np.float32)
        rest, sure = field.update(given, np.ones(8, bool), 0.02 if number else 0.0)
        assert np.array_equal(rest[:, :3], given[:, :3])
        assert sure[:3].all()
    assert sure.all()
    assert np.abs(rest[:, 3:]).max() < 1
    rest, sure = field.update((level * 5).astype(np.float32), np.ones(8, bool), 700.0)
    assert np.array_equal(sure, [True] * 3 + [False] * 5)
    assert np.abs(rest[:, 3:]).max() == pytest.approx(0, abs=1e-3)
    assert np.abs(field.now).max() < 1
