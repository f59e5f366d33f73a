"""Claims of skinware.tactile, judged by physics: a ball presses and drags over a pad, a gripper loosens its grip.

Scenes and transfer are those of `--world mujoco:pad` and `mujoco:gripper`; the values are those that drivers read
(tests/virtual/test_physics_on_wires.py), 100 a second. Places, forces and speeds are random by the seed alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.tactile import Baseline, Contacts
from skinware.tactile.calibration.force import ForceData, fit_force
from skinware.tactile.contacts import ContactSet
from skinware.tactile.curves import CurveTable
from skinware.tactile.neighbours import neighbours
from skinware.tactile.testing import Surface
from skinware.tactile.tracking import ContactKind
from skinware_drivers.virtual.physics.binding import Bound, find_binding
from skinware_drivers.virtual.physics.world import PhysicsWorld

ArrayF = npt.NDArray[np.float64]
PERIOD_NS = 10_000_000
REST, SWING_M = 1000, 0.006
SLIPS_M_S = 0.002
"""Speed from which the ball slips; it creeps below it."""
FOUND_S = 0.030
SIDE = 8
HELD = 50
"""Frames at the end of a press, when it no longer changes."""
WEIGHT_N = 0.05 * 9.81
"""The weight of the ball, N."""


class Frame(NamedTuple):
    """Figures of skinware, and the true ones."""

    time_s: float
    load: ArrayF
    contacts: ContactSet
    point_m: ArrayF | None
    force_n: float
    slip_m_s: float


class Twin:
    """Normal forces of a world through baseline and contacts."""

    def __init__(self, bound: Bound, seed: int, device: int = 1) -> None:
        self.world = PhysicsWorld(bound, seed=seed)
        self.scene = self.world.scene
        self._device = device
        [module] = [one for one in self.scene.modules if one.binding.device == device]
        self._module, self.n = self.scene.modules.index(module), len(module.position_m)
        self._baseline = Baseline(np.zeros(self.n, int), np.zeros(self.n, int))
        places = Surface.at(module.position_m).geometry(module.binding.body)
        self._contacts = Contacts(self.n, neighbours(places), places)
        self._time_ns = 0

    def frames(self, seconds: float) -> Iterator[Frame]:
        """Let the world run."""
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            self._time_ns += PERIOD_NS
            values = REST + np.rint(self.world.added(self._device, self._time_ns, self.n))
            calm = self._baseline.update(self._time_ns, values)
            contacts = self._contacts.update(calm.value, calm.touched, self._time_ns)
            touches = [touch for touch in self.scene.touching() if touch.module == self._module]
            force_n = sum(touch.normal_n for touch in touches)
            point: ArrayF | None = None
            if force_n > 0:
                point = np.sum([touch.point_m * touch.normal_n for touch in touches], axis=0) / force_n
            slip_m_s = max((touch.slip_m_s for touch in touches), default=0.0)
            load = np.asarray(calm.value, np.float64)
            yield Frame(self._time_ns / 1e9, load, contacts, point, force_n, slip_m_s)

    def wait(self, seconds: float) -> list[Frame]:
        return list(self.frames(seconds))


def pad(seed: int) -> Twin:
    """A pad of 8 x 8 taxels at a pitch of 3 mm, with the transfer of the shipped one; it has rested for 8 s."""
    bound = find_binding("mujoco:pad", "xela")
    [module] = bound.binding.module
    grid = msgspec.structs.replace(module, rows=SIDE, columns=SIDE, axes="z")
    binding = msgspec.structs.replace(bound.binding, module=(grid,), move=())
    twin = Twin(msgspec.structs.replace(bound, binding=binding), seed)
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


def slip_onset(seed: int, slips: int) -> str:
    random, twin, late_s, false, held_s = np.random.default_rng([seed, 3]), pad(seed), [], 0, 0.0
    for _ in range(slips):
        start = random.uniform(-SWING_M, 0, 2)
        press(twin, start, float(random.uniform(1, 4)))
        for frame in twin.frames(float(random.uniform(0.2, 1.0))):
            false += bool((np.asarray(frame.contacts.kind) == ContactKind.SLIDING).any())
            held_s += PERIOD_NS / 1e9
        distance_m, speed_m_s = random.uniform(0.004, 0.008), random.uniform(0.01, 0.05)
        twin.scene.actuators.move({"x": start[0] + distance_m}, distance_m / speed_m_s)
        begun, found = None, None
        for frame in twin.frames(distance_m / speed_m_s + 0.3):
            begun = frame.time_s if begun is None and frame.slip_m_s > SLIPS_M_S else begun
            if begun is not None and (np.asarray(frame.contacts.kind) == ContactKind.SLIDING).any():
                found = frame.time_s - begun
                break
        late_s.append(np.inf if found is None else found)
    share = np.mean(np.array(late_s) <= FOUND_S)
    caught = [late for late in late_s if np.isfinite(late)]
    median = f"{1e3 * np.median(caught):.0f} ms" if caught else "none"
    per_minute = false * PERIOD_NS / 1e9 / held_s * 60
    text = f"{100 * share:.0f} % within 30 ms; {len(caught)} of {slips} found at all, median {median}"
    wanted = "95 % of slips, 1 s of false slip a minute"
    verdict = judged(bool(share >= 0.95 and per_minute <= 1))
    return f"{text}; {per_minute:.1f} s of false slip a minute | {wanted} | {verdict}"


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


def judged(holds: bool) -> str:
    return "holds" if holds else "MISSED"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--presses", type=int, default=60)
    parser.add_argument("--slips", type=int, default=200)
    parser.add_argument("--hold", type=float, default=60.0, help="seconds of a firm grip, and of a loosened one")
    arguments = parser.parse_args()
    rows: dict[str, Callable[[], str]] = {
        "centre of pressure, pitch 3 mm": lambda: centre_of_pressure(arguments.seed, arguments.presses),
        "force after calibration, 0.5 s of rest between presses": lambda: force(arguments.seed, arguments.presses, 0.5),
        "force after calibration, 5 s of rest": lambda: force(arguments.seed, arguments.presses, 5.0),
        "slip onset": lambda: slip_onset(arguments.seed, arguments.slips),
        "loosened grip": lambda: loosened_grip(arguments.seed, arguments.hold),
    }
    print("| claim | by physics | wanted | |\n|---|---|---|---|")
    for name, row in rows.items():
        print(f"| {name} | {row()} |", flush=True)


if __name__ == "__main__":
    main()
