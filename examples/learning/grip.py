"""Learn to grip objects of unknown size and stiffness, with and without touch.

A finger closes on an object until it holds it with 4 N. An expert that knows the force shows how; its touch is recorded
as that of any driver, and becomes a LeRobot dataset. A small policy learns from the dataset, and then moves the finger
itself, reading the skin live::

    python grip.py make grips                # 60 grips in 75 s: grips/grips.mcap, and the dataset grips/set
    python grip.py train grips               # 5 seeds with and without touch; needs lerobot and torch
    python grip.py plot grips                # grips/curves.png; needs matplotlib

The finger and its pad of 4 x 4 taxels are simulated here; all else is as with a real hand.
"""

from __future__ import annotations

import csv
import json
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import DriverWriter, Structure
from skinware.learning import LiveTouch, Totals
from skinware.realtime import Periodic
from skinware.sensor_types import PRESSURE

RATE_HZ, STEPS, GRIPS = 50, 60, 60
WANTED_N, TOLERANCE_N = 4.0, 0.8
FASTEST = 0.05
"""Largest step of the finger, of its way from open (0) to closed (1)."""
SEEDS, HIDDEN, BATCH = 5, 64, 256
CHECKPOINTS = (50, 100, 200, 400, 800)
"""Steps of training after which the policy grips."""
TRIALS = 20

PAD = Structure(
    types=[PRESSURE.measured(unit="counts", minimum=0.0, maximum=255.0)],
    buses=["simulated"],
    patch_name=["finger"],
    patch_bus=[0],
    module_patch=[0],
    module_kind=["4x4"],
    sensor_uid=np.arange(16),
    sensor_type=[PRESSURE.id] * 16,
    sensor_module=[0] * 16,
    dtype="<f4",
)


@dataclass
class Grip:
    """One object between finger and thumb.

    Attributes:
        width: closing at which the finger meets it, 0 to 1.
        stiffness: N for the whole way beyond that.
        spot: (2,) where on the pad it presses, in taxels.
    """

    width: float
    stiffness: float
    spot: npt.NDArray[np.float64]
    closing: float = 0.0

    @classmethod
    def random(cls, generator: np.random.Generator) -> Grip:
        return cls(generator.uniform(0.25, 0.75), generator.uniform(20, 60), generator.uniform(1, 2, 2))

    @property
    def force_n(self) -> float:
        return max(0.0, self.closing - self.width) * self.stiffness

    def move(self, step: float) -> None:
        self.closing = float(np.clip(self.closing + np.clip(step, -1, 1) * FASTEST, 0, 1))

    def publish(self, writer: DriverWriter, generator: np.random.Generator) -> int:
        """Publish what the pad feels, with noise, and return when."""
        row, column = np.divmod(np.arange(16), 4)
        near = np.exp(-((row - self.spot[0]) ** 2 + (column - self.spot[1]) ** 2) / 1.5)
        columns, time_ns = writer.begin(), time.monotonic_ns()
        columns["values"][:] = np.clip(8 * self.force_n * near + generator.normal(2, 1, 16), 0, 255)
        columns["status"][:] = 0
        columns["module_time_ns"][:] = time_ns
        writer.commit(time_ns)
        return time_ns


def expert(force_n: float) -> float:
    """Return the step of one who feels the force: fast until it touches, then ever more slowly."""
    return float(np.clip((WANTED_N - force_n) / WANTED_N, -1, 1))


def make(folder: Path) -> None:
    """Record the grips of the expert, and make a LeRobot dataset of them."""
    from skinware.conversion.learning import Join, LearningSet, convert_to_learning_set
    from skinware.recording.files import Files
    from skinware.recording.recorder import Recorder

    folder.mkdir()
    generator = np.random.default_rng(0)
    recorder = Recorder(Files(folder / "grips.mcap"))
    thread = threading.Thread(target=recorder.run)
    thread.start()
    with DriverWriter("finger", PAD, rate_hz=RATE_HZ) as writer, (folder / "joints.csv").open("w") as file:
        rows = csv.writer(file)
        rows.writerow(("monotonic_ns", "closing", "step"))
        for number in range(GRIPS):
            grip = Grip.random(generator)
            for turn, _ in enumerate(Periodic(RATE_HZ)):
                time_ns = grip.publish(writer, generator)
                if turn == 0:
                    recorder.mark(f"grip {number}", time_ns)
                if turn == STEPS:
                    recorder.mark("end", time_ns)
                    break
                step = expert(grip.force_n) + generator.normal(0, 0.1)  # so that it sees how to mend an error
                rows.writerow((time_ns, f"{grip.closing:.5f}", f"{expert(grip.force_n):.5f}"))
                grip.move(step)
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
    for name, columns in (
        ("without", ["closing"]),
        ("with touch", ["closing", "touch.finger.sum.vel", "touch.finger.peak.vel"]),
    ):
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
    """Return the share of new objects that a policy holds at the end with about the wanted force."""
    generator = np.random.default_rng(1000 + seed)
    held = 0
    with DriverWriter("finger", PAD, rate_hz=RATE_HZ) as writer:
        Grip.random(generator).publish(writer, generator)
        with LiveTouch(drivers=["finger"]) as live, torch.no_grad():
            totals = Totals(live.layout, "pressure", live.positions)
            for _ in range(TRIALS):
                grip = Grip.random(generator)
                for _ in range(STEPS):
                    touch = live.at(grip.publish(writer, generator))
                    state = [grip.closing, *(totals.of(touch.values).tolist() if has_touch else [])]
                    grip.move(float(policy(torch.tensor([state]))))
                held += abs(grip.force_n - WANTED_N) <= TOLERANCE_N
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
