"""Claims of skinware.tactile, judged by physics: a ball presses and drags over a pad, a gripper loosens its grip.

Scenes and transfer are those of `--world mujoco:pad` and `mujoco:gripper`; the values are those that drivers read
(tests/virtual/test_physics_on_wires.py), 100 a second; slip is also judged at 200 and 500. Places, forces and speeds
are random by the seed alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from skinware.tactile import Baseline, Contacts
from skinware.tactile.calibration.force import ForceData, fit_force
from skinware.tactile.contacts import ContactSet
from skinware.tactile.curves import CurveTable
from skinware.tactile.neighbours import neighbours
from skinware.tactile.onsets import EventKind, Events
from skinware.tactile.testing import Surface
from skinware_drivers.learning import SkinEnv
from skinware_drivers.virtual.physics import WORLD_NS
from skinware_drivers.virtual.physics.binding import Bound, find_binding
from skinware_drivers.virtual.physics.scene import Touching
from skinware_drivers.virtual.physics.world import PhysicsWorld
from tests.specification.chain import Onsets
from tests.virtual.self_touch import RADIUS_M, gathered, placed, self_touch

ArrayF = npt.NDArray[np.float64]
PERIOD_NS = 10_000_000
RATES_HZ = 100, 200, 500
REST, SWING_M = 1000, 0.006
SLIPS_M_S = 0.002
"""Speed from which the ball slips; it creeps below it."""
FOUND_S, FORGIVEN_S = 0.030, 0.1
"""From slip to its event; and after a slip, how long another event is not a false one."""
SIDE = 8
ROUNDS = 5
HELD = 50
"""Frames at the end of a press, when it no longer changes."""
WEIGHT_N = 0.05 * 9.81
"""The weight of the ball, N."""


class Frame(NamedTuple):
    """Figures of skinware, and the true ones; slip is the fastest since the frame before."""

    time_s: float
    load: ArrayF
    contacts: ContactSet
    point_m: ArrayF | None
    force_n: float
    slip_m_s: float
    slipped: bool


class Twin:
    """Normal forces of a world through baseline and contacts."""

    def __init__(self, bound: Bound, seed: int, device: int = 1, rate_hz: float = 100) -> None:
        self.world = PhysicsWorld(bound, seed=seed)
        self.scene = self.world.scene
        self._device = device
        [module] = [one for one in self.scene.modules if one.binding.device == device]
        self._module, self.n = self.scene.modules.index(module), len(module.position_m)
        self._baseline = Baseline(np.zeros(self.n, int), np.zeros(self.n, int))
        places = Surface.at(module.position_m).geometry(module.binding.body)
        self._contacts = Contacts(self.n, neighbours(places), places)
        self._onsets, self._events = Onsets(self.n, 1.0), Events()
        self._time_ns, self._period_ns = 0, round(1e9 / rate_hz)

    def frames(self, seconds: float) -> Iterator[Frame]:
        """Let the world run."""
        for _ in range(round(seconds * 1e9 / self._period_ns)):
            begin_ns, self._time_ns = self._time_ns, self._time_ns + self._period_ns
            slip_m_s = 0.0
            for time_ns in range(begin_ns, self._time_ns, WORLD_NS):
                self.world.advance(min(time_ns + WORLD_NS, self._time_ns))
                slip_m_s = max(slip_m_s, *(touch.slip_m_s for touch in self._touches()), 0.0)
            values = REST + np.rint(self.world.added(self._device, self._time_ns, self.n))
            calm = self._baseline.update(self._time_ns, values)
            above = values - calm.baseline
            onset = self._onsets.update(above, np.hypot(calm.noise, calm.uncertainty), calm.usable)
            contacts = self._contacts.update(
                calm.value, calm.touched, self._time_ns, onset=onset, sigmas=above / calm.noise
            )
            events = self._events.of(contacts, self._time_ns)
            slipped = any(event.kind is EventKind.SLIPPED for event in events)
            touches = self._touches()
            force_n = sum(touch.normal_n for touch in touches)
            point: ArrayF | None = None
            if force_n > 0:
                point = np.sum([touch.point_m * touch.normal_n for touch in touches], axis=0) / force_n
            load = np.asarray(calm.value, np.float64)
            yield Frame(self._time_ns / 1e9, load, contacts, point, force_n, slip_m_s, slipped)

    def _touches(self) -> list[Touching]:
        return [touch for touch in self.scene.touching() if touch.module == self._module]

    def wait(self, seconds: float) -> list[Frame]:
        return list(self.frames(seconds))


def pad(seed: int, rate_hz: float = 100) -> Twin:
    """A pad of 8 x 8 taxels at a pitch of 3 mm, with the transfer of the shipped one; it has rested for 8 s."""
    bound = find_binding("mujoco:pad", "xela")
    [module] = bound.binding.module
    grid = msgspec.structs.replace(module, rows=SIDE, columns=SIDE, axes="z")
    binding = msgspec.structs.replace(bound.binding, module=(grid,), move=())
    twin = Twin(msgspec.structs.replace(bound, binding=binding), seed, rate_hz=rate_hz)
    twin.scene.actuators.move({"press": -1.0})
    twin.wait(8)
    return twin


def press(twin: Twin, at_m: ArrayF, force_n: float, rest_s: float = 0.5) -> list[Frame]:
    """Let the pad rest, press it for a second, and return all frames."""
    twin.scene.actuators.move({"press": -1.0, "x": at_m[0], "y": at_m[1]})
    frames = twin.wait(rest_s)
    twin.scene.actuators.move({"press": force_n - WEIGHT_N}, 0.2)
    return frames + twin.wait(1.0)


def centre_of_pressure(seed: int, presses: int) -> str:
    random, twin, off_mm, missed = np.random.default_rng([seed, 1]), pad(seed), [], 0
    for _ in range(presses):
        for frame in press(twin, random.uniform(-SWING_M, SWING_M, 2), float(random.uniform(0.8, 4)))[-HELD:]:
            if frame.point_m is None:
                continue
            if not len(frame.contacts):
                missed += 1
                continue
            largest = int(np.argmax(frame.contacts.load))
            off_mm.append(1e3 * np.linalg.norm(frame.contacts.cop_m[largest][:2] - frame.point_m[:2]))
    p50, p95, most = np.percentile(off_mm, [50, 95, 100])
    verdict = judged(p95 <= 1.5)
    return (
        f"p50 {p50:.2f}, p95 {p95:.2f}, most {most:.2f} mm; {missed} frames without a contact | p95 1.5 mm | {verdict}"
    )


def force(seed: int, presses: int, rest_s: float) -> str:
    random, twin = np.random.default_rng([seed, 2]), pad(seed)
    taught, asked = (
        [
            press(twin, random.uniform(-SWING_M, SWING_M, 2), float(random.uniform(0.8, 4)), rest_s)
            for _ in range(presses)
        ]
        for _ in range(2)
    )

    def data(frames: list[Frame]) -> ForceData:
        return ForceData(
            np.array([frame.time_s for frame in frames]),
            np.array([frame.load for frame in frames]),
            np.array([frame.force_n for frame in frames]),
            np.full(len(frames), np.nan),
        )

    uid = np.arange(twin.n, dtype=np.uint64)
    table = CurveTable(fit_force(data([frame for frames in taught for frame in frames])).curves(uid), "pressure", uid)
    off = []
    for frames in asked:
        found_n = [float(np.sum(table.step(frame.load.astype(np.float32), PERIOD_NS / 1e9))) for frame in frames]
        for frame, found in zip(frames[-HELD:], found_n[-HELD:], strict=True):
            off.append(100 * abs(found - frame.force_n) / frame.force_n)
    p50, p95, most = np.percentile(off, [50, 95, 100])
    return f"p50 {p50:.1f}, p95 {p95:.1f}, most {most:.1f} % | p95 10 % | {judged(p95 <= 10)}"


def slip_onset(seed: int, slips: int, rate_hz: float) -> str:
    random, twin = np.random.default_rng([seed, 3]), pad(seed, rate_hz)
    late_s, false, watched_s, slid_s = [], 0, 0.0, -np.inf
    for _ in range(slips):
        start = random.uniform(-SWING_M, 0, 2)
        at_rest = press(twin, start, float(random.uniform(1, 4)))
        at_rest += twin.wait(float(random.uniform(0.2, 1.0)))
        distance_m, speed_m_s = random.uniform(0.004, 0.008), random.uniform(0.01, 0.05)
        twin.scene.actuators.move({"x": start[0] + distance_m}, distance_m / speed_m_s)
        frames = twin.wait(distance_m / speed_m_s + 0.3)
        begun = next(frame.time_s for frame in frames if frame.slip_m_s > SLIPS_M_S)
        late_s.append(next((frame.time_s for frame in frames if frame.slipped), np.inf) - begun)
        for frame in at_rest:
            slid_s = frame.time_s if frame.slip_m_s > SLIPS_M_S else slid_s
            if frame.time_s - slid_s > FORGIVEN_S:
                false += frame.slipped
                watched_s += 1 / rate_hz
        slid_s = frames[-1].time_s
    late = np.array(late_s)
    share, found = np.mean(late <= FOUND_S + 1e-6), late[np.isfinite(late)]
    median, most = (1e3 * of(found) if len(found) else np.nan for of in (np.median, np.max))
    text = f"{100 * share:.1f} % within 30 ms; {len(found)} of {slips} found at all, "
    text += f"median {median:.0f}, most {most:.0f} ms"
    verdict = judged(bool(share >= 0.95 and false <= watched_s / 60))
    return f"{text}; {false} false in {watched_s:.0f} s of presses and rest | 95 %, 1 false a minute | {verdict}"


def loosened_grip(seed: int, hold_s: float) -> str:
    bound = find_binding("mujoco:gripper", "robotiq_tsf")
    binding = msgspec.structs.replace(bound.binding, move=())
    twin = Twin(msgspec.structs.replace(bound, binding=binding), seed, device=0)
    scene = twin.scene
    twin.wait(8)
    scene.actuators.move(scene.actuators.poses["down"], 1.0)
    twin.wait(1.2)
    scene.actuators.move(scene.actuators.poses["grip"], 0.5)
    twin.wait(hold_s)
    scene.actuators.move({"close": 0.0135}, 1.0)
    twin.wait(1.5)
    felt = [bool(len(frame.contacts)) for frame in twin.frames(hold_s) if frame.force_n > 0.2]
    scene.actuators.move(scene.actuators.poses["open"], 0.5)
    after = twin.wait(3)[100:]
    left = sum(bool(len(frame.contacts)) for frame in after)
    share = np.mean(felt)
    verdict = judged(share == 1 and left == 0)
    text = f"felt in {100 * share:.1f} % of {len(felt)} frames; {left} frames felt after it was let go"
    return f"{text} | 100 %, 0 | {verdict}"


def self_touch_places(seed: int, presses: int) -> str:
    with TemporaryDirectory() as folder:
        world = PhysicsWorld(find_binding(self_touch(Path(folder), presses, seed), "xela"))
    session = gathered(world, presses, world.scene.carried)
    off_mm = 1e3 * np.linalg.norm(placed(world, session, RADIUS_M)[1], axis=1)
    text = f"p50 {np.median(off_mm):.2f}, most {off_mm.max():.2f} mm; {len(session.presses)} of {presses} presses found"
    return f"{text} | half a pitch, 1.5 mm | {judged(bool(off_mm.max() <= 1.5))}"


def learning(seed: int, steps: int) -> str:
    """Return steps a second of the fastest of some rounds, as others may use the processor's caches."""
    rate_hz, per_s = 50.0, []
    lift, close, tray, tray_lift = np.zeros((4, steps))
    lift[:], close[:] = -0.065, np.linspace(0, 0.02, steps)
    actions = np.column_stack([lift, close, tray, tray_lift])

    def fastest(env: SkinEnv, act: Callable[[Any], object]) -> float:
        taken_s = []
        for _ in range(ROUNDS):
            env.reset(seed=seed)
            begin_s = time.process_time()
            for action in actions:
                act(action)
            taken_s.append(time.process_time() - begin_s)
        return steps / min(taken_s)

    for through_driver in (False, True):
        env = SkinEnv("mujoco:gripper", "robotiq_tsf", rate_hz=rate_hz, through_driver=through_driver)
        model, data = env.scene.model, env.scene.data
        substeps = round(1 / rate_hz / model.opt.timestep)

        def physics(action: ArrayF, model: Any = model, data: Any = data, substeps: int = substeps) -> None:
            data.ctrl[:] = action
            mujoco.mj_step(model, data, substeps)

        per_s.append(fastest(env, env.step))
        alone = fastest(env, physics)
        env.close()
    direct, driven = per_s
    text = f"{direct:.0f} steps a second of a processor without a wire, {driven:.0f} through it: {direct / driven:.1f}"
    text += f" times; MuJoCo alone {alone:.0f}"
    return f"{text}; {direct / rate_hz:.1f} times real time | 100 times | {judged(direct >= 100 * driven)}"


def judged(holds: bool) -> str:
    return "holds" if holds else "MISSED"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--presses", type=int, default=60)
    parser.add_argument("--slips", type=int, default=200)
    parser.add_argument("--only", default="", help="rows whose names have this in them")
    parser.add_argument("--hold", type=float, default=60.0, help="seconds of a firm grip, and of a loosened one")
    arguments = parser.parse_args()
    rows: dict[str, Callable[[], str]] = {
        "centre of pressure, pitch 3 mm": lambda: centre_of_pressure(arguments.seed, arguments.presses),
        "force after calibration, 0.5 s of rest between presses": lambda: force(arguments.seed, arguments.presses, 0.5),
        "force after calibration, 5 s of rest": lambda: force(arguments.seed, arguments.presses, 5.0),
        **{f"slip onset at {rate} Hz": partial(slip_onset, arguments.seed, arguments.slips, rate) for rate in RATES_HZ},
        "loosened grip": lambda: loosened_grip(arguments.seed, arguments.hold),
        "calibration by self-touch, pitch 3 mm": lambda: self_touch_places(arguments.seed, 2 * arguments.presses),
        "learning, 50 steps a second of the gripper": lambda: learning(arguments.seed, 500),
    }
    print("| claim | by physics | wanted | |\n|---|---|---|---|")
    for name, row in rows.items():
        if arguments.only not in name:
            continue
        print(f"| {name} | {row()} |", flush=True)


if __name__ == "__main__":
    main()
