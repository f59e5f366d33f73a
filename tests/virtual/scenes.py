"""Scenes for tests: bindings of any device to the pad, and what their frames must say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.virtual.device import EmulatorOptions
from skinware_drivers.virtual.hardware import load_emulator
from skinware_drivers.virtual.physics.binding import SCENES, Bound
from skinware_drivers.virtual.physics.scene import PhysicsScene
from skinware_drivers.virtual.physics.transfer import Transfer

PAD = SCENES / "pad.xml"
ERRORS = """
[transfer]
counts_per_n = {counts}
saturation_n = 6.0
gain_spread = 0.1
crosstalk = 0.2
hysteresis = 0.05
creep = 0.1
remainder = 0.1
noise = {noise}
drift = {noise}
drift_s = 7.0
warmth = 1.0
warming_k = 3.0
warming_s = 2.0
"""
PRESS = """
[pose.press]
press = 2.0
[[move]]
at_s = 0.1
pose = "press"
seconds = 0.3
"""


def on_the_pad(folder: Path, *modules: str, counts: float = 1000, noise: float = 3.0, more: str = PRESS) -> str:
    """Write a binding of modules to the pad; return the world."""
    bound = "".join(f'\n[[module]]\nbody = "pad"\n{module}\n' for module in modules)
    text = f'format = "skinware-binding"\nversion = 1\nscene = "{PAD}"\n{ERRORS.format(counts=counts, noise=noise)}'
    (folder / "binding.toml").write_text(text + bound + more)
    return f"mujoco:{folder / 'binding.toml'}"


def hardware_in(world: str, driver: str, **options: Any) -> tuple[Any, list[tuple[int, float]]]:
    """Return devices in a world, and the list that gets (device, time of the scene, s) of all that they sample."""
    emulator = load_emulator(driver)
    hardware: Any = emulator(emulator.Options(world=world, world_services=False, **options))
    sampled: list[tuple[int, float]] = []
    added = hardware.world.added

    def note(device: int, time_ns: int, n_values: int) -> npt.NDArray[np.float64]:
        result: npt.NDArray[np.float64] = added(device, time_ns, n_values)
        sampled.append((device, hardware.world.since_s(time_ns)))
        return result

    hardware.world.added = note
    return hardware, sampled


def expected_counts(
    bound: Bound, sampled: list[tuple[int, float]], seed: int = EmulatorOptions().seed
) -> list[dict[int, npt.NDArray[np.float64]]]:
    """Return the counts of each module of the device at each sample: MuJoCo's data, through the transfer."""
    scene = PhysicsScene(bound)
    transfers = [
        Transfer(bound.settings(module.binding), module.position_m, (seed, module.binding.device, number))
        for number, module in enumerate(scene.modules)
    ]
    found = []
    for device, time_s in sampled:
        scene.step_to(time_s)
        newtons = scene.newtons()
        found.append(
            {
                number: transfers[number].counts(newtons[number], time_s)
                for number, module in enumerate(scene.modules)
                if module.binding.device == device
            }
        )
    return found


def course_of(scene: PhysicsScene, until_s: float, every_s: float = 0.02) -> Any:
    """Step a scene by its own moves; yield (time_s, normal force on each module, N, contacts of modules)."""
    while scene.time_s < until_s - every_s / 2:
        scene.step_to(scene.time_s + every_s)
        yield scene.time_s, [float(forces[:, 2].sum()) for forces in scene.newtons()], scene.touching()
