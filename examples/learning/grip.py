"""Learn to grip cups of unknown width and stiffness, with and without touch.

A simulated gripper closes on a cup until each finger holds it with 4 N. An expert that knows the force shows how; its
touch is recorded as that of any driver, and becomes a LeRobot dataset. A small policy learns from the dataset, and then
moves the gripper itself::

    python grip.py make grips                # 60 grips in 75 s: grips/grips.mcap, and the dataset grips/set
    python grip.py train grips               # 5 seeds with and without touch; needs lerobot and torch
    python grip.py plot grips                # grips/curves.png; needs matplotlib

`Grip` is an environment of Gymnasium, for any program that learns; all else is as with a real hand.
"""

from __future__ import annotations

import csv
import json
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from skinware import DriverWriter, Structure
from skinware.realtime import Periodic
from skinware.sensor_types import PRESSURE
from skinware_drivers.learning import SkinEnv

RATE_HZ, STEPS, GRIPS = 50, 60, 60
WANTED_N, TOLERANCE_N = 4.0, 0.8
FASTEST_M = 0.0015
"""Largest step of the fingers' target."""
DOWN_M = -0.065
SEEDS, HIDDEN, BATCH = 5, 64, 256
CHECKPOINTS = (50, 100, 200, 400, 800)
"""Steps of training after which the policy grips."""
TRIALS = 20

PADS = Structure(
    types=[PRESSURE.measured(unit="counts", minimum=0.0, maximum=65535.0)],
    buses=["simulated"],
    patch_name=["left", "right"],
    patch_bus=[0, 0],
    module_patch=[0, 1],
    module_kind=["7x4", "7x4"],
    sensor_uid=np.arange(56),
    sensor_type=[PRESSURE.id] * 56,
    sensor_module=np.repeat([0, 1], 28),
    dtype="<f4",
)


class Grip(SkinEnv):
    """A gripper around a cup. An action, (1,) in -1 to 1, is a step of its fingers: 1 closes them as fast as it can."""

    def __init__(self, **more: Any) -> None:
        super().__init__("mujoco:gripper", "robotiq_tsf", actuators=["close"], rate_hz=RATE_HZ, steps=STEPS, **more)
        self.closed_m, self.open_m = self.action_space.high[0], 0.0
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def begin(self, options: Mapping[str, Any]) -> None:
        self.target_m = self.open_m
        self.scene.data.joint("lift").qpos[:] = DOWN_M
        self.scene.actuators.move({"lift": DOWN_M})
        self.scene.model.geom("cup").size[0] = self.np_random.uniform(0.018, 0.028)
        stiffness = self.np_random.uniform(300, 4000)
        for pad in ("left_pad", "right_pad"):
            self.scene.model.geom(pad).solref[0] = -stiffness

    def step(self, action: Any) -> Any:
        step_m = float(np.clip(action[0], -1, 1)) * FASTEST_M
        self.target_m = float(np.clip(self.target_m + step_m, self.open_m, self.closed_m))
        return super().step(np.array([self.target_m]))

    def judge(self, action: Any) -> tuple[float, bool]:
        force_n = sum(touch.normal_n for touch in self.scene.touching()) / 2
        return -abs(force_n - WANTED_N) / WANTED_N, False


def expert(info: Mapping[str, Any]) -> float:
    """Return the step of one who feels the force: fast until it touches, then ever more slowly."""
    return float(np.clip((WANTED_N - info["force_n"].mean()) / WANTED_N, -1, 1))


def publish(writer: DriverWriter, observation: Mapping[str, Any]) -> int:
    """Publish what the pads feel, and return when."""
    columns, time_ns = writer.begin(), time.monotonic_ns()
    columns["values"][:] = observation["touch"]
    columns["status"][:] = 0
    columns["module_time_ns"][:] = time_ns
    writer.commit(time_ns)
    return time_ns


def state_of(observation: Mapping[str, Any], has_touch: bool) -> list[float]:
    """Return the closing of the fingers, m, and with touch also the sum and the largest value of each pad."""
    pads = observation["touch"].reshape(2, -1)
    touch = np.column_stack([pads.sum(axis=1), pads.max(axis=1)]).ravel()
    return [float(observation["position"][0]), *(touch.tolist() if has_touch else [])]


def make(folder: Path) -> None:
    """Record the grips of the expert, and make a LeRobot dataset of them."""
    from skinware.conversion.learning import Join, LearningSet, convert_to_learning_set
    from skinware.recording.files import Files
    from skinware.recording.recorder import Recorder

    folder.mkdir()
    generator, env = np.random.default_rng(0), Grip()
    recorder = Recorder(Files(folder / "grips.mcap"))
    thread = threading.Thread(target=recorder.run)
    thread.start()
    with DriverWriter("fingers", PADS, rate_hz=RATE_HZ) as writer, (folder / "joints.csv").open("w") as file:
        rows = csv.writer(file)
        rows.writerow(("monotonic_ns", "closing", "step"))
        for number in range(GRIPS):
            observation, info = env.reset(seed=number)
            for turn, _ in enumerate(Periodic(RATE_HZ)):
                time_ns = publish(writer, observation)
                if turn == 0:
                    recorder.mark(f"grip {number}", time_ns)
                if turn == STEPS:
                    recorder.mark("end", time_ns)
                    break
                rows.writerow((time_ns, f"{observation['position'][0]:.6f}", f"{expert(info):.5f}"))
                step = expert(info) + generator.normal(0, 0.1)  # so that it sees how to mend an error
                observation, *_, info = env.step([step])
    env.close()
    recorder.stop()
    thread.join()
    joins = [
        Join("observation.state", folder / "joints.csv", ("closing",)),
        Join("action", folder / "joints.csv", ("step",)),
    ]
    wanted = LearningSet(fps=RATE_HZ, by_marks=True, form="state", joins=joins, within_s=10, task="grip")
    made = convert_to_learning_set([folder / "grips.mcap"], folder / "set", wanted)
    print(f"{made.path}: {made.episodes} episodes")


def train(folder: Path) -> None:
    """Train policies with and without touch, and let each grip; write the shares that were held."""
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    torch.set_num_threads(1)  # for so small a network, more cost more
    dataset = LeRobotDataset("skinware/grips", root=folder / "set")
    names = dataset.meta.features["observation.state"]["names"]
    states, actions = (
        torch.stack([torch.as_tensor(each) for each in dataset.hf_dataset[name]]).float()
        for name in ("observation.state", "action")
    )
    actions = actions.reshape(len(actions), 1)
    curves: dict[str, list[list[float]]] = {}
    touch = [f"touch.{pad}.{number}.vel" for pad in ("left", "right") for number in ("sum", "peak")]
    for name, columns in (("without", ["closing"]), ("with touch", ["closing", *touch])):
        inputs = states[:, [names.index(column) for column in columns]]
        curves[name] = [_curve(torch, inputs, actions, seed) for seed in range(SEEDS)]
        last = [curve[-1] for curve in curves[name]]
        print(f"{name}: {np.mean(last):.0%} held in the end, {min(last):.0%} to {max(last):.0%} over {SEEDS} seeds")
    (folder / "curves.json").write_text(json.dumps({"steps": CHECKPOINTS, **curves}))


def _curve(torch: Any, inputs: Any, actions: Any, seed: int) -> list[float]:
    """Train one policy; the share of grips that it holds after each checkpoint."""
    torch.manual_seed(seed)
    mean, spread = inputs.mean(0), inputs.std(0) + 1e-6
    layers = (
        torch.nn.Linear(inputs.shape[1], HIDDEN),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN, HIDDEN),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN, 1),
    )
    policy = torch.nn.Sequential(*layers)
    optimizer = torch.optim.Adam(policy.parameters(), 2e-3)
    shares = []
    for number in range(1, CHECKPOINTS[-1] + 1):
        chosen = torch.randint(len(inputs), (BATCH,))
        loss = torch.nn.functional.mse_loss(policy((inputs[chosen] - mean) / spread), actions[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if number in CHECKPOINTS:
            shares.append(_held(torch, lambda state: policy((state - mean) / spread), inputs.shape[1] > 1, seed))
    return shares


def _held(torch: Any, policy: Any, has_touch: bool, seed: int) -> float:
    """Return the share of new cups that a policy holds in the end with about the wanted force."""
    env, held = Grip(), 0
    with torch.no_grad():
        for trial in range(TRIALS):
            observation, info = env.reset(seed=1000 * (seed + 1) + trial)
            for _ in range(STEPS):
                observation, *_, info = env.step(policy(torch.tensor([state_of(observation, has_touch)]))[0].numpy())
            held += abs(info["force_n"].mean() - WANTED_N) <= TOLERANCE_N
    env.close()
    return held / TRIALS


def plot(folder: Path) -> None:
    """Draw what touch gives: mean and range of the seeds after each checkpoint."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    curves = json.loads((folder / "curves.json").read_text())
    steps = curves.pop("steps")
    figure, axes = pyplot.subplots(figsize=(6, 4))
    for name, of_seeds in curves.items():
        shares = np.array(of_seeds) * 100
        axes.plot(steps, shares.mean(axis=0), marker="o", label=name)
        axes.fill_between(steps, shares.min(axis=0), shares.max(axis=0), alpha=0.2)
    axes.set(xlabel="steps of training", ylabel=f"held with {WANTED_N:g} ± {TOLERANCE_N:g} N, %", ylim=(-2, 102))
    axes.legend(loc="center right")
    figure.tight_layout()
    figure.savefig(folder / "curves.png", dpi=150)


if __name__ == "__main__":
    {"make": make, "train": train, "plot": plot}[sys.argv[1]](Path(sys.argv[2]))
