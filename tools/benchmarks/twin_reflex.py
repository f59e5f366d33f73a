"""A reflex on a simulated gripper: from contact in physics to the command that stops it, stage by stage, through CAN.

The scene `gripper`, with steps of 1 ms, presses the fingertips of an emulated Allegro hand; the driver, skin-calm and
examples/reflex.py are a process each, with real-time priorities where root starts them. The fingers close at random
speeds. The time of the contact, to a step, is that of the scene in the time of the device, so that physics and devices
that come late count.

--speed 0.25: the scene runs at a quarter of real time, for a slow machine. Periods, limit and table are in the time of
the scene: frames come at a quarter of their rate, and each program takes a quarter of the time that it takes.

--bus virtual: the devices are in the driver's process. --bus vcan0: skin-emulate is a process, too; the interface is
made. `tools/bench twin-reflex --lab` does this in User-Mode Linux; the first line says how fast that is.
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
import threading
import time
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skinware import Namespace
from skinware.errors import Closed
from skinware.service import ServiceReader

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "skinware_drivers" / "virtual" / "physics" / "scenes" / "gripper.xml"
PRIORITY = 40
"""Priority of the driver; that of the emulator is one less, that of each program behind the driver one more."""
SETTLED_S = 8.0
OPEN_S = 0.3
LIMIT_MS = 12
KEPT = 4096
"""Samples of the driver that are kept, to look at those of a contact behind it."""
SLOWEST = 5
STAGES = (
    "contact to its first frame",
    "to the frame of the onset",
    "until it is published",
    "to the reader",
    "to the stop",
)
BINDING = """
format = "skinware-binding"
version = 1
scene = "gripper.xml"
transfer = {counts_per_n = 9000, saturation_n = 8.0, hysteresis = 0.04, noise = 3.0}
module = [
    {device = 0, first = 0, body = "left_finger", rows = 1, reach_m = 0.03, x = [0, -1, 0], y = [0, 0, -1]},
    {device = 0, first = 3, body = "right_finger", rows = 1, reach_m = 0.03, x = [0, 1, 0], y = [0, 0, -1]},
]
"""


class Closing(NamedTuple):
    """The times of a closing, stage by stage.

    Attributes:
        all_ms: from the contact to the stop.
        stages_ms: (stages,) durations; NaN where this program has missed the frame of the onset.
        counts: of both fingertips above their rest, in each frame from the contact to that of the onset.
        pressed_n: force half a second later.
    """

    all_ms: float
    stages_ms: list[float]
    counts: list[list[int]]
    pressed_n: float


class Kept(NamedTuple):
    """A sample of the driver: its times, and the counts of both fingertips."""

    acquired_ns: int
    published_ns: int
    counts: Any


def commands(bus: str, period_ms: int, speed: float, folder: Path, calm: str) -> list[tuple[str, ...]]:
    """Return the commands to start, in order; the last one is the reflex."""
    (folder / "gripper.xml").write_text(SCENE.read_text().replace('timestep="0.002"', 'timestep="0.001"'))
    (folder / "gripper.toml").write_text(BINDING)
    world = f"mujoco:{folder / 'gripper.toml'}"
    profile = ("--realtime", f"fifo:{PRIORITY}") if os.geteuid() == 0 else ()
    driver: tuple[str, ...] = ("skin-driver", "--driver", "allegro_v5", "--model", "tips", "--latency", "0")
    driver += "--period-ms", str(period_ms), "--slots", "64", *profile
    rest = [
        ("skin-calm", "allegro_v5", "--into", calm),
        (sys.executable, str(ROOT / "examples" / "reflex.py"), calm, "joints"),
    ]
    if bus == "virtual":
        options = f"world={world}&world_speed={speed}&period_ms={period_ms}"
        return [(*driver, "--bus", f"virtual:allegro_v5_tips?{options}"), *rest]
    emulator = "skin-emulate", "--driver", "allegro_v5_tips", "--bus", bus, "--period-ms", str(period_ms)
    physics = "--world", world, "--world-speed", str(speed), "--json"
    return [(*emulator, *physics), (*driver, "--bus", bus), *rest]


def run(
    started: list[tuple[str, ...]], closings: int, seed: int, speed: float, folder: Path
) -> tuple[list[Closing], int]:
    """Close the gripper again and again; return what was stopped, and how many were not."""
    random, found, missed = np.random.default_rng(seed), [], 0
    pids: list[int] = []
    events = folder / f"log{len(started) - 1}"
    with ExitStack() as stack:
        for number, command in enumerate(started):
            output = stack.enter_context((folder / f"log{number}").open("w"))
            profile = ("chrt", "-f", str(PRIORITY + 3 + number - len(started))) if os.geteuid() == 0 else ()
            process = subprocess.Popen((*profile, *command), stdout=output, stderr=subprocess.STDOUT)
            pids.append(process.pid)
            stack.callback(process.wait, 20)
            stack.callback(process.send_signal, signal.SIGTERM)
            time.sleep(2)
        truth = stack.enter_context(ServiceReader("truth", timeout_s=60))
        joints = stack.enter_context(ServiceReader("joints", timeout_s=60))
        kept: deque[Kept] = deque(maxlen=KEPT)
        frames = stack.enter_context(ServiceReader("allegro_v5", timeout_s=60))
        threading.Thread(target=keep, args=(frames, kept), daemon=True).start()
        joints.call("move", targets={"lift": -0.065, "close": 0.0}, seconds=1.0, timeout_s=30)
        time.sleep(SETTLED_S)
        used_s, from_s = [cpu_s(pid) for pid in pids], time.monotonic()
        for _ in range(closings):
            joints.call("move", targets={"close": 0.0}, seconds=OPEN_S)
            time.sleep(OPEN_S / speed + 1.2)
            seen = len(events.read_text().splitlines())
            seconds = float(random.uniform(0.8, 2.5))
            joints.call("move", targets={"close": 0.025}, seconds=seconds)
            time.sleep((seconds + 0.5) / speed)
            samples = [truth.request() for _ in range(10)]  # the scene's time is that of its last step
            since_s = [float(one.column("touched_s")[0] - one.column("scene_s")[0]) / speed for one in samples]
            contact_ns = np.min([one.acquired_ns + 1e9 * since for one, since in zip(samples, since_s, strict=True)])
            lines = events.read_text().splitlines()[seen:]
            begun = [re.findall(r"\d+", line) for line in lines if line.startswith(("onset", "confirmed"))]
            if begun and np.isfinite(contact_ns):
                _, read_us, done_us, frame_ns = map(int, begun[0])
                pressed_n = float(samples[-1].column("force_n")[0])
                found.append(closing(list(kept), int(contact_ns), frame_ns, (read_us, done_us), pressed_n, speed))
            else:
                missed += 1
        shares = [(cpu_s(pid) - before) / (time.monotonic() - from_s) for pid, before in zip(pids, used_s, strict=True)]
        print(f"shares of a processor, in the order of frames: {', '.join(f'{share:.2f}' for share in shares)}")
        if missed:
            ends = [(folder / f"log{number}").read_text()[-600:] for number in range(len(started))]
            print("\n".join(ends), file=sys.stderr)
    return found, missed


def keep(frames: ServiceReader[Any], kept: deque[Kept]) -> None:
    """Keep the newest samples of the driver."""
    with suppress(Closed):
        for sample in frames.in_order():
            kept.append(Kept(sample.acquired_ns, sample.published_ns, sample.column("values")[::3].astype(int)[:2]))


def closing(
    kept: list[Kept], contact_ns: int, frame_ns: int, ages_us: tuple[int, int], pressed_n: float, speed: float
) -> Closing:
    """Return the times of a closing."""
    all_ms = (frame_ns + 1000 * ages_us[1] - contact_ns) / 1e6 * speed
    rest = [one for one in kept if one.acquired_ns < contact_ns]
    between = [one for one in kept if contact_ns <= one.acquired_ns <= frame_ns]
    if not rest or not between or between[-1].acquired_ns != frame_ns:
        return Closing(all_ms, [np.nan] * len(STAGES), [], pressed_n)
    published_ns = between[-1].published_ns
    times_ns = [contact_ns, between[0].acquired_ns, frame_ns, published_ns, *(frame_ns + 1000 * us for us in ages_us)]
    above = [(one.counts - rest[-1].counts).tolist() for one in between]
    return Closing(all_ms, (np.diff(times_ns) / 1e6 * speed).tolist(), above, pressed_n)


def table(found: list[Closing]) -> str:
    """Return the durations of all stages, and those of the slowest closings."""
    stages_ms = np.array([[*one.stages_ms, one.all_ms] for one in found])
    lines = ["| ms | p50 | p99 | most |", "|---|---|---|---|"]
    for name, of_stage in zip((*STAGES, "all"), stages_ms.T, strict=True):
        lines.append(f"| {name} | {' | '.join(f'{one:.1f}' for one in np.nanpercentile(of_stage, [50, 99, 100]))} |")
    lines.append("\nthe slowest, stage by stage, and counts of both fingertips from frame to frame:")
    lines += [
        f"{' + '.join(f'{one:.1f}' for one in found[row].stages_ms)} ms: {found[row].counts}"
        for row in np.argsort(-stages_ms[:, -1])[:SLOWEST]
    ]
    return "\n".join(lines)


def cpu_s(pid: int) -> float:
    """Return the time that a process has computed, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def speed_of_this_machine() -> str:
    """Return how long a loop of Python, a system call and the wait for a millisecond take."""

    def duration_us(action: Any, times: int = 1) -> float:
        begin_ns = time.perf_counter_ns()
        for _ in range(times):
            action()
        return (time.perf_counter_ns() - begin_ns) / 1e3 / times

    loop_ms = min(duration_us(lambda: sum(range(1_000_000))) for _ in range(5)) / 1e3
    call_us = duration_us(os.getppid, 1000)
    woken_ms = np.percentile([duration_us(lambda: time.sleep(0.001)) / 1e3 for _ in range(200)], [50, 99])
    woken = "p50 {:.1f}, p99 {:.1f} ms".format(*woken_ms)
    return f"a sum of 1e6 numbers {loop_ms:.0f} ms, a system call {call_us:.1f} us, a sleep of 1 ms {woken}"


def preload_clock() -> None:
    """Give the processes that are started from now on a clock without system calls."""
    library = Path("/tmp/lab_clock.so")
    subprocess.run(
        ["cc", "-O2", "-shared", "-fPIC", "-o", library, Path(__file__).with_name("lab_clock.c")], check=True
    )
    os.environ["LD_PRELOAD"] = str(library)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bus", default="virtual")
    parser.add_argument("--period-ms", type=int, default=2)
    parser.add_argument("--speed", type=float, default=1.0, help="seconds of the scene in a second (default: 1)")
    parser.add_argument("--closings", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    bus = arguments.bus
    if bus != "virtual" and not Path("/sys/class/net", bus).exists():
        subprocess.run(["ip", "link", "add", "dev", bus, "type", "vcan"], check=True)
        subprocess.run(["ip", "link", "set", bus, "up"], check=True)
    if os.environ.get("SKINWARE_CAN_LAB_KERNEL") == "user":
        preload_clock()
    source, calm = (Namespace(f"bench-{os.getpid()}-{name}") for name in ("source", "calm"))
    os.environ["SKINWARE_NAMESPACE"] = source.name
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}: {speed_of_this_machine()}", flush=True)
    try:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            period_ms = round(arguments.period_ms / arguments.speed)
            started = commands(bus, period_ms, arguments.speed, folder, calm.name)
            found, missed = run(started, arguments.closings, arguments.seed, arguments.speed, folder)
    finally:
        for namespace in (source, calm):
            shutil.rmtree(namespace.path, ignore_errors=True)
    if found:
        print(f"\n{arguments.period_ms} ms a frame on {bus}, {arguments.speed:g} of real time:\n\n{table(found)}")
        holds = missed == 0 and np.percentile([one.all_ms for one in found], 99) <= LIMIT_MS
        pressed_n = np.median([one.pressed_n for one in found])
        print(f"\np99 of {LIMIT_MS} ms: {'holds' if holds else 'MISSED'}; it then presses {pressed_n:.2f} N")
    unknown = sum(not one.counts for one in found)
    print(f"{len(found)} closings stopped, {missed} not; {unknown} without stages: this program missed their samples")


if __name__ == "__main__":
    main()
