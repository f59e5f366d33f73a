"""The demo geometry, the finger that walks over it, and what somebody does as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.testing import Push, Stroke, Surface, Wander, World, arm, arm_path, read_stage
from skinware.tactile.testing.surface import CHANNELS_M


def distances(surface: Surface) -> npt.NDArray[np.float64]:
    found: npt.NDArray[np.float64] = np.linalg.norm(surface.position_m[:, np.newaxis] - surface.position_m, axis=2)
    np.fill_diagonal(found, np.inf)
    return found


def pieces(surface: Surface, radius_m: float) -> list[int]:
    """Sizes of what hangs together."""
    near = distances(surface) <= radius_m
    left, sizes = set(range(len(surface))), []
    while left:
        todo, size = [left.pop()], 0
        while todo:
            size += 1
            found = left.intersection(np.flatnonzero(near[todo.pop()]).tolist())
            left -= found
            todo += found
        sizes.append(size)
    return sorted(sizes)


def test_the_arm_is_a_forearm_a_palm_and_a_back() -> None:
    surface = arm()
    assert (len(surface), surface.n_modules, surface.n_patches) == (640, 64, 4)
    assert pieces(surface, 0.012) == [80, 80, 480]


def test_triangles_are_rigid_flat_and_as_far_apart_as_their_taxels() -> None:
    surface = arm()
    between = distances(surface)
    for module in range(surface.n_modules):
        of_module = surface.module == module
        position = surface.position_m[of_module]
        assert np.allclose(between[:10, :10], between[np.ix_(of_module, of_module)])
        assert np.allclose((position - position[0]) @ surface.normal[of_module][0], 0)
    other = surface.module[:, np.newaxis] != surface.module
    assert between[other].min() > 0.005
    assert np.allclose(np.linalg.norm(surface.normal, axis=1), 1)


def test_seen_from_outside_no_triangle_is_mirrored() -> None:
    surface = arm()
    for module in range(surface.n_modules):
        corners = surface.position_m[surface.module == module][[1, 5, 8]]  # channels 1, 5 and 9: the corners
        facing = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        flat = CHANNELS_M[[1, 5, 9]]
        turn = np.sign(np.linalg.det(flat[1:] - flat[0]))
        assert np.sign(facing @ surface.normal[10 * module]) == turn


def test_normals_point_outwards() -> None:
    surface = arm()
    from_axis = surface.position_m * [0, 1, 1]
    assert (np.einsum("ij,ij->i", from_axis, surface.normal) > 0.01).all()


def test_pads_lie_within_their_triangle_and_the_other_channels_stay() -> None:
    with_pads, without = arm(pads=True), arm()
    twelve = with_pads.position_m.reshape(-1, 12, 3)
    assert np.array_equal(np.delete(twelve, [6, 10], axis=1).reshape(-1, 3), without.position_m)
    for pad in (6, 10):
        nearest = np.sort(np.linalg.norm(CHANNELS_M[np.delete(np.arange(12), pad)] - CHANNELS_M[pad], axis=1))[:3]
        assert np.allclose(nearest, 0.0065 / np.sqrt(3))


@pytest.mark.thorough
def test_more_boards_are_another_arm_and_none_is_where_another_is() -> None:
    surface = arm(range(-6, 8))
    assert distances(surface).min() > 0.005
    assert surface.n_patches == 14
    assert np.array_equal(arm([5]).position_m[:, [0, 2]], arm([1]).position_m[:, [0, 2]])


@pytest.mark.parametrize("board", range(4))
def test_a_walk_over_a_board_passes_over_each_triangle_once(board: int) -> None:
    path = arm_path(board)
    centres = arm([board]).position_m.reshape(16, 10, 3).mean(axis=1)
    between = np.linalg.norm(path[:, np.newaxis] - centres, axis=2)
    assert sorted(between.argmin(axis=1).tolist()) == list(range(16))
    assert np.allclose(between.min(axis=1), 0)
    steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
    assert steps.max() < 0.03


def test_a_finger_wanders_round_and_round_and_lets_go() -> None:
    world = World(arm([0]), noise=0, dtype=np.float32, step=0)
    path = tuple((x, y, z) for x, y, z in arm_path(0).tolist())
    finger = Wander(path_m=path, force=100, begin_s=2, end_s=1e6, rise_s=0.5, radius_m=0.006)
    world.gestures.append(finger)
    time_s = np.arange(0, 40, 0.02)
    felt = world.felt(time_s, slice(None))
    assert not felt[time_s < 2].any()
    pressing = finger.forces(time_s) > 0
    assert np.array_equal(felt.any(axis=1), pressing)
    assert pressing[time_s >= 2].mean() == pytest.approx(2.6 / 4, abs=0.03)
    touched = (felt > 30).reshape(len(time_s), 16, 10).any(axis=(0, 2))
    assert touched.all()
    held = finger.forces(time_s) == 100
    middle = (felt @ world.surface.position_m)[held] / felt.sum(axis=1)[held][:, np.newaxis]
    assert np.linalg.norm(middle - finger.points_m(time_s)[held], axis=1).max() < 0.008
    assert np.array_equal(world.record(8).truth > 0, world.felt(np.arange(400) / 50, slice(None)).astype("f4") > 0)


def test_what_some_taxels_feel_at_any_time_is_what_the_frames_show() -> None:
    world = World(arm([0, 3]), noise=0, dtype=np.float32, step=0, idle=0, minimum=-1e9, maximum=1e9)
    world.push(world.surface.position_m[5], 50, 0.2, 0.9)
    world.stroke(arm_path(3)[:5], 60, 0.1, 1)
    world.cover([7, 200], 20, 0.3, 0.5)
    world.dead(5)
    block = world.record(1)
    of_patch = (block.module_time_ns[:, ::16] - 1_000_000_000) / 1e9
    for patch in range(2):
        taxels = world.surface.patch == patch
        assert np.allclose(world.felt(of_patch[:, patch], taxels), block.values[:, taxels], atol=1e-3)


STAGE = """
format = "skinware-stage"
version = 1
repeat_s = 12.0

[[push]]
at_m = [0.07, 0.0225, 0.0]
force_n = 3.0
begin_s = 1.0
end_s = 4.0
name = "first"

[[stroke]]
path_m = [[0.02, 0.0225, 0.0], [0.12, 0.0225, 0.0]]
force_n = 4.0
begin_s = 5.0
end_s = 9.0
radius_m = 0.0
rise_s = 1.0
"""


def test_a_stage_file_says_what_somebody_does(tmp_path: Path) -> None:
    file = tmp_path / "stage.toml"
    file.write_text(STAGE)
    play = read_stage(file)
    assert play.repeat_s == 12
    push, stroke = play.gestures
    assert push == Push(at_m=(0.07, 0.0225, 0), force=3, begin_s=1, end_s=4, radius_m=0.006, name="first")
    assert stroke == Stroke(path_m=((0.02, 0.0225, 0), (0.12, 0.0225, 0)), force=4, begin_s=5, end_s=9, rise_s=1)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("skinware-stage", "skinware-geometry", r"stage.toml:2: no stage file"),
        ("version = 1", "version = 2", r"stage.toml:3: version 2, this Skinware reads version 1"),
        ("repeat_s = 12.0", "repeat_s = 0", r"stage.toml:4"),
        ("force_n = 3.0", 'force_n = "hard"', r"stage.toml:8"),
        ("begin_s = 1.0\n", "begin_s = 1.0\nspeed = 3\n", r"speed"),
        ("end_s = 4.0", "end_s = 0.5", r"stage.toml:6: .*no time to rise and fall"),
        ("[[0.02, 0.0225, 0.0], ", "[", r"stage.toml:13: .*at least two points"),
        ("at_m = [0.07, 0.0225, 0.0]\n", "", r"at_m"),
        ('format = "', "format = ", r"stage.toml"),
    ],
)
def test_a_mistake_in_a_stage_file_is_told_with_its_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert STAGE.count(old) == 1
    file = tmp_path / "stage.toml"
    file.write_text(STAGE.replace(old, new))
    with pytest.raises(ConfigurationError, match=words):
        read_stage(file)


def test_a_stage_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nothing\.toml"):
        read_stage(tmp_path / "nothing.toml")
