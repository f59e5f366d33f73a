"""A simulated body as an environment of Gymnasium: through wire and driver as without them, by seeds alone."""

from __future__ import annotations

import asyncio
import importlib
import os
import runpy
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")
pytest.importorskip("gymnasium", reason="needs the extra mujoco")

import gymnasium
import mujoco
from gymnasium.utils.env_checker import check_env

from skinware.errors import BusNotAvailable, ConfigurationError, MissingExtra, PlatformError
from skinware_drivers.learning import SkinEnv
from skinware_drivers.loading import registered
from skinware_drivers.registry import DRIVERS
from skinware_drivers.virtual.hardware import load_emulator
from skinware_drivers.virtual.physics.binding import find_binding

from .scenes import on_the_pad

EXAMPLE = Path(__file__).parents[2] / "examples" / "learning" / "grip.py"
DOWN, RATE_HZ = -0.065, 50.0


class Cup(SkinEnv):
    """Grip a cup whose width is random."""

    def __init__(self, **more: Any) -> None:
        super().__init__("mujoco:gripper", "robotiq_tsf", actuators=["lift", "close"], rate_hz=RATE_HZ, **more)

    def begin(self, options: Mapping[str, Any]) -> None:
        self.scene.data.joint("lift").qpos[:] = DOWN
        self.scene.model.geom("cup").size[0] = options.get("radius_m", self.np_random.uniform(0.02, 0.025))

    def judge(self, action: npt.NDArray[np.float32]) -> tuple[float, bool]:
        force_n = sum(touch.normal_n for touch in self.scene.touching())
        return min(force_n, 10.0) - abs(float(action[1])), force_n > 12


def grips(steps: int = 40) -> Iterator[npt.NDArray[np.float32]]:
    """Yield actions that grip the cup and lift it."""
    for step in range(steps):
        yield np.array([DOWN + max(0, step - 25) * 0.004, min(step * 0.0015, 0.022)], np.float32)


def course(env: SkinEnv, seed: int) -> tuple[list[Any], list[dict[str, Any]]]:
    """Return (touch, position, reward) as bytes and numbers, and the information, of each step of an episode."""
    observation, info = env.reset(seed=seed)
    rows, infos = [(observation["touch"].tobytes(), observation["position"].tobytes(), 0.0)], [info]
    for action in grips():
        observation, reward, _, _, info = env.step(action)
        rows.append((observation["touch"].tobytes(), observation["position"].tobytes(), reward))
        infos.append(info)
    return rows, infos


def test_values_through_wire_and_driver_are_those_without() -> None:
    with closing(Cup()) as direct, closing(Cup(through_driver=True)) as driven:
        for seed in (4, 5):
            (felt, truth), (read, said) = course(direct, seed), course(driven, seed)
            assert read == felt, "each value of each step"
            assert [info["force_n"].tolist() for info in said] == [info["force_n"].tolist() for info in truth]
            assert all(info["fresh"] for info in said)
            assert truth[0]["force_n"].tolist() == [0, 0]
            assert min(truth[-1]["force_n"]) > 2, "it holds the cup"
            assert len({touch for touch, _, _ in felt}) == len(felt), "every step felt something else"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("world", "driver", "pose", "taxels"),
    [("pad", "xela", "press", 48), ("hand", "inspire", "closed", 1062), ("hand", "linkerhand", "closed", 360)],
)
def test_other_bodies_on_other_wires(world: str, driver: str, pose: str, taxels: int) -> None:
    poses = find_binding(f"mujoco:{world}", driver).binding.pose
    one, other = (
        SkinEnv(f"mujoco:{world}", driver, rate_hz=10, through_driver=through_driver)
        for through_driver in (False, True)
    )
    with closing(one) as direct, closing(other) as driven:
        felt, read = direct.reset(seed=1)[0], driven.reset(seed=1)[0]
        assert felt["touch"].shape == (taxels,)
        most_n = 0.0
        action = np.array([poses[pose].get(name, 0.0) for name in direct.scene.actuators.names], np.float32)
        for _ in range(10):
            felt, *_, info = direct.step(action)
            read, *_ = driven.step(action)
            assert np.array_equal(read["touch"], felt["touch"])
            most_n = max(most_n, info["force_n"].sum())
        assert most_n > 1


OTHER_NUMBERS = ("canopen", "dev001", "papillarray", "paxini", "wuji_glove", "xela_server")
PRESSED_DOWN, OWN_TOUCH = ("icub_eth", "tactile_glove"), ("roboskin",)
"""Values of the former fall under a press, which no transfer makes; the latter has a touch of its own."""


@pytest.mark.thorough
@pytest.mark.parametrize("driver", sorted({*registered(DRIVERS)} - {*PRESSED_DOWN, *OWN_TOUCH}))
def test_each_driver_shows_what_its_devices_feel_or_is_refused(driver: str, tmp_path: Path) -> None:
    emulator: Any = load_emulator(driver)
    hardware = emulator(emulator.Options())
    rows, counts = min(len(hardware.places()), 16), float(np.max(hardware.swing)) / 3
    module = f"rows = {rows}\npitch_m = [0.001, 0.0015]\ndevice = {hardware.numbers[0]}"
    world = on_the_pad(tmp_path, module, counts=counts)
    if driver in OTHER_NUMBERS:
        with pytest.raises(ConfigurationError, match="its devices feel"):
            SkinEnv(world, driver, rate_hz=5, through_driver=True)
        return
    with (
        closing(SkinEnv(world, driver, rate_hz=5)) as direct,
        closing(SkinEnv(world, driver, rate_hz=5, through_driver=True)) as driven,
    ):
        felt, read = [direct.reset(seed=1)[0]["touch"]], [driven.reset(seed=1)[0]["touch"]]
        for press in np.linspace(-1, 3, 8):
            action = np.array([{"press": press}.get(name, 0) for name in direct.scene.actuators.names], np.float32)
            felt.append(direct.step(action)[0]["touch"])
            read.append(driven.step(action)[0]["touch"])
    assert np.array_equal(read, felt)
    assert np.ptp(felt, axis=0).max() > 0.3 * counts


def test_a_seed_is_an_episode_bit_by_bit() -> None:
    with closing(Cup()) as env, closing(Cup()) as another:
        first = course(env, 7)[0]
        assert course(env, 8)[0] != first
        assert course(env, 7)[0] == first, "after other episodes"
        assert course(another, 7)[0] == first


def test_an_episode_ends() -> None:
    with closing(Cup(steps=5)) as env:
        env.reset(seed=1)
        ends = [env.step(action)[2:4] for action in grips(5)]
        assert ends == [(False, False)] * 4 + [(False, True)]
        env.reset(seed=1, options={"radius_m": 0.02})
        assert env.scene.model.geom("cup").size[0] == 0.02
        done = [env.step(np.array([DOWN, 0.03], np.float32))[2] for _ in range(20)]
        assert not done[0]
        assert done[-1], "more than 12 N"


def test_the_expert_of_the_example_holds_any_cup() -> None:
    grip = runpy.run_path(str(EXAMPLE))
    with closing(grip["Grip"]()) as env:
        for seed in range(4):
            observation, info = env.reset(seed=seed)
            truncated = False
            while not truncated:
                observation, reward, _, truncated, info = env.step([grip["expert"](info)])
            assert info["force_n"].mean() == pytest.approx(grip["WANTED_N"], abs=0.1)
            assert reward == pytest.approx(0, abs=0.03)
            closing_m, *touch = grip["state_of"](observation, True)
            assert closing_m == pytest.approx(observation["position"][0])
            assert touch == [number for pad in np.split(observation["touch"], 2) for number in (pad.sum(), pad.max())]


RECOMMENDED = "ignore:.*(symmetric and normalized|observation space m...mum value):UserWarning"


@pytest.mark.filterwarnings(RECOMMENDED)
@pytest.mark.parametrize("through_driver", [False, True])
def test_gymnasium_finds_nothing_wrong(through_driver: bool) -> None:
    gymnasium.register("skinware/Cup-v0", Cup, kwargs={"through_driver": through_driver})
    try:
        with closing(gymnasium.make("skinware/Cup-v0", max_episode_steps=20)) as made:
            check_env(made.unwrapped, skip_render_check=True)
    finally:
        del gymnasium.registry["skinware/Cup-v0"]


def test_side_by_side() -> None:
    makers = [lambda through=through: Cup(through_driver=through) for through in (False, True, True)]
    with closing(gymnasium.vector.SyncVectorEnv(makers)) as envs:
        observations, _ = envs.reset(seed=[1, 1, 2])
        for action in grips(20):
            observations, *_, infos = envs.step(np.tile(action, (3, 1)))
        touch = observations["touch"]
        assert np.array_equal(touch[0], touch[1])
        assert not np.array_equal(touch[1], touch[2])
        assert infos["force_n"].shape == (3, 2)


def test_in_the_loop_of_a_notebook() -> None:
    async def cell() -> bool:
        with closing(Cup(through_driver=True)) as env:
            env.reset(seed=1)
            return bool(env.step(next(grips()))[4]["fresh"])

    assert asyncio.run(cell())


def test_faults_of_the_wire_are_seen() -> None:
    with closing(Cup(through_driver=True, options={"lose": 0.3, "seed": 2})) as env:
        lossy = course(env, 4)[1]
    fresh = [info["fresh"] for info in lossy]
    assert 0 < sum(fresh) < len(fresh)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"actuators": ["lifd"]}, "there is no actuator 'lifd'; there are lift, close"),
        ({"rate_hz": 1}, "rate_hz 1: give at least 2"),
        ({"options": {"lose": 2}}, "options of EmulatedRobotiqTsf: .*lose"),
        ({"through_driver": True, "driver_options": {"period": 2}}, "options of RobotiqTsfDriver: .*period"),
        ({"render_mode": "human"}, "render_mode 'human': give None or rgb_array"),
    ],
)
def test_mistakes(more: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        SkinEnv("mujoco:gripper", "robotiq_tsf", **more)


def test_devices_that_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware_drivers.learning._LONGEST_START_S", 2.0)
    with pytest.raises(ConfigurationError, match="the driver has 96 sensors, its devices feel 93"):
        SkinEnv("mujoco:hand", "paxini", through_driver=True)
    with pytest.raises(ConfigurationError, match="roboskin: these emulated devices have a touch of their own"):
        SkinEnv("mujoco:forearm", "roboskin")
    with pytest.raises(BusNotAvailable, match="robotiq_tsf: no values of all devices"):
        Cup(through_driver=True, options={"dead": [0, 1], "dead_after_s": 0})


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "skinware_drivers.learning")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingExtra, match=r"pip install 'skinware\[mujoco\]'"):
        importlib.import_module("skinware_drivers.learning")


def test_actions_that_are_none() -> None:
    with closing(Cup()) as env:
        env.reset(seed=1)
        with pytest.raises(ConfigurationError, match=r"action of shape \(3,\): give \(2,\)"):
            env.step(np.zeros(3, np.float32))
        with pytest.raises(ConfigurationError, match="lift=nan is no number"):
            env.step(np.array([np.nan, 0], np.float32))


def test_a_machine_that_draws_nothing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def renderer(*_arguments: Any) -> None:
        raise RuntimeError("no context")

    monkeypatch.setattr(mujoco, "Renderer", renderer)
    with closing(Cup(render_mode="rgb_array")) as env:
        env.reset(seed=1)
        with pytest.raises(
            PlatformError, match=r"no picture \(no context\): start Python with MUJOCO_GL=egl or osmesa"
        ):
            env.render()
    with closing(Cup()) as blind:
        assert blind.render() is None


FORGOTTEN = """
from skinware_drivers.learning import SkinEnv
env = SkinEnv("mujoco:gripper", "robotiq_tsf", through_driver=True)
env.reset()
print(env._wire._namespace.path)
"""


@pytest.mark.thorough
def test_one_that_was_not_closed_leaves_nothing_behind() -> None:
    run = subprocess.run([sys.executable, "-c", FORGOTTEN], capture_output=True, text=True, check=True)
    assert run.stderr == ""
    assert run.stdout.startswith("/dev/shm/")
    assert not Path(run.stdout.strip()).exists()


DRAWN = """
from skinware.errors import PlatformError
from skinware_drivers.learning import SkinEnv
env = SkinEnv("mujoco:gripper", "robotiq_tsf", render_mode="rgb_array")
env.reset()
try:
    print(env.render().shape, env.render().std() > 1)
except PlatformError as error:
    print(error)
env.close()
"""


@pytest.mark.thorough
def test_a_picture() -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    run = subprocess.run([sys.executable, "-c", DRAWN], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout in ("(360, 480, 3) True\n",) or run.stdout.startswith("no picture ("), run.stdout
