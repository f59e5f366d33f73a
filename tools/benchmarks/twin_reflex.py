"""A reflex on a simulated gripper: from contact in physics to the command that stops it, stage by stage.

skin-emulate with the scene `gripper` on a pseudo terminal, skin-driver, skin-calm and examples/reflex.py are a process
each, with real-time priorities where root starts them. The fingers close at random speeds; both moments are times of
the scene, to a step of 2 ms.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from skinware import Namespace
from skinware.service import ServiceReader

ROOT = Path(__file__).resolve().parents[2]
PERIOD_MS = 5
PRIORITY = 20
SETTLED_S = 8.0
BINDING = """
format = "skinware-binding"
version = 1
scene = "{scenes}/gripper.xml"
transfer = {{counts_per_n = 9000, saturation_n = 8.0, crosstalk = 0.2, hysteresis = 0.04, noise = 3.0}}
module = [
    {{device = 0, body = "left_finger", {grid}, x = [0, -1, 0], y = [0, 0, -1]}},
    {{body = "right_finger", {grid}, x = [0, 1, 0], y = [0, 0, -1]}},
]
"""


Stages = dict[str, list[float]]


def run(closings: int, seed: int, folder: Path, calm: str) -> tuple[Stages, list[float], int]:
    """Close the gripper again and again; return the stages, ms, the forces 0.5 s later, N, and the misses."""
    scenes = ROOT / "skinware_drivers" / "virtual" / "physics" / "scenes"
    binding, port = folder / "gripper.toml", folder / "port"
    binding.write_text(BINDING.format(scenes=scenes, grid="rows = 7, columns = 4, pitch_m = [0.005, 0.005]"))
    world = ("--world", f"mujoco:{binding}")
    commands = [
        ("skin-emulate", "--driver", "robotiq_tsf", "--bus", f"pty:{port}", *world),
        ("skin-driver", "--driver", "robotiq_tsf", "--bus", str(port), "--period-ms", str(PERIOD_MS), "--latency", "0"),
        ("skin-calm", "robotiq_tsf", "--into", calm),
        (sys.executable, str(ROOT / "examples" / "reflex.py"), calm, "joints"),
    ]
    random, pressed_n, missed = np.random.default_rng(seed), [], 0
    late: Stages = {name: [] for name in ("contact to frame", "frame to event", "event to command", "all")}
    with ExitStack() as stack:
        for number, command in enumerate(commands):
            output = stack.enter_context((folder / f"log{number}").open("w"))
            profile = ("chrt", "-f", str(PRIORITY + number)) if os.geteuid() == 0 else ()
            process = subprocess.Popen((*profile, *command), stdout=output, stderr=subprocess.STDOUT)
            stack.callback(process.wait, 20)
            stack.callback(process.send_signal, signal.SIGTERM)
            time.sleep(2)
        truth = stack.enter_context(ServiceReader("truth", timeout_s=20))
        joints = stack.enter_context(ServiceReader("joints", timeout_s=20))
        joints.call("move", targets={"lift": -0.065, "close": 0.0}, seconds=1.0)
        time.sleep(SETTLED_S)
        for _ in range(closings):
            joints.call("move", targets={"close": 0.0}, seconds=0.3)
            time.sleep(1.5)
            seen = len((folder / "log3").read_text().splitlines())
            asked_s = float(joints.request().column("commanded_s")[0])
            joints.call("move", targets={"close": 0.025}, seconds=float(random.uniform(0.8, 2.5)))
            asked_s = max(asked_s, float(joints.request().column("commanded_s")[0]))
            commanded_s, until = _first_command_s(joints, asked_s), time.monotonic() + 0.5
            touched_s = float(truth.request().column("touched_s")[0])
            time.sleep(max(0.0, until - time.monotonic()))
            lines = (folder / "log3").read_text().splitlines()[seen:]
            begun = [re.findall(r"[\d.]+", line) for line in lines if line.startswith(("onset", "confirmed"))]
            if commanded_s > asked_s and begun:
                all_ms = 1e3 * (commanded_s - touched_s)
                event_ms, acted_ms = (float(number) / 1e3 for number in begun[0][1:])
                stages_ms = all_ms - acted_ms, event_ms, acted_ms - event_ms, all_ms
                for of_stage, stage_ms in zip(late.values(), stages_ms, strict=True):
                    of_stage.append(stage_ms)
                pressed_n.append(float(truth.request().column("force_n")[0]))
            else:
                missed += 1
    return late, pressed_n, missed


def _first_command_s(joints: ServiceReader[Any], asked_s: float) -> float:
    """Return the time of the scene at the first command after one; NaN: none came within 4 s."""
    until = time.monotonic() + 4
    for sample in joints.in_order(timeout_s=5):
        commanded_s = float(sample.column("commanded_s")[0])
        if commanded_s > asked_s:
            return commanded_s
        if time.monotonic() > until:
            break
    return float("nan")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--closings", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    source, calm = (Namespace(f"bench-{os.getpid()}-{name}") for name in ("source", "calm"))
    os.environ["SKINWARE_NAMESPACE"] = source.name
    try:
        with tempfile.TemporaryDirectory() as folder:
            late, pressed_n, missed = run(arguments.closings, arguments.seed, Path(folder), calm.name)
    finally:
        for namespace in (source, calm):
            shutil.rmtree(namespace.path, ignore_errors=True)
    if pressed_n:
        print(
            f"{PERIOD_MS} ms a frame, load {os.getloadavg()[0]:.1f}, ms:\n\n| | p50 | p99 | most |\n|---|---|---|---|"
        )
        for name, of_stage in late.items():
            print(f"| {name} | {' | '.join(f'{one:.1f}' for one in np.percentile(of_stage, [50, 99, 100]))} |")
        print(f"\nit then presses {np.median(pressed_n):.2f} N")
    print(f"{len(pressed_n)} closings stopped, {missed} not")


if __name__ == "__main__":
    main()
