"""Physics under emulated devices: a MuJoCo scene presses their taxels. Needs the extra ``mujoco``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skinware.errors import MissingExtra
from skinware_drivers.virtual.device import EmulatorOptions
from skinware_drivers.virtual.hardware import name_of

if TYPE_CHECKING:
    from skinware_drivers.virtual.physics.world import PhysicsWorld

WORLD_NS = 2_000_000
"""Time between two looks at the commands of a world."""


def open_world(options: EmulatorOptions, emulator: type) -> PhysicsWorld | None:
    if not options.world:
        return None
    try:
        from skinware_drivers.virtual.physics.binding import find_binding
        from skinware_drivers.virtual.physics.world import PhysicsWorld
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise MissingExtra.of("the option world", "skinware[mujoco]") from None
    return PhysicsWorld(
        find_binding(options.world, name_of(emulator)),
        seed=options.seed,
        speed=options.world_speed,
        has_services=options.world_services,
    )
