"""Simulate a skin with places, somebody who presses it, and the faults of real skins, as a truth to test against.

It gives arrays, so that an algorithm can be compared with the load that no real skin knows::

    from skinware.tactile.testing import World, grid

    world = World(grid(modules=10), seed=1, drift_per_min=0.5, noise=0.8)
    world.push(world.surface.position_m[5], 25, begin_s=10, end_s=20)
    for sample in world.samples(until_s=30):
        sample.values, sample.truth  # (n,) both
"""

from skinware.tactile.testing.gestures import Cover, Gesture, Play, Push, Stroke, Wander, read_stage
from skinware.tactile.testing.response import Response
from skinware.tactile.testing.surface import ARM_FRAME, Surface, arm, arm_path, grid, triangles
from skinware.tactile.testing.world import Block, Sample, World

__all__ = [
    "ARM_FRAME",
    "Block",
    "Cover",
    "Gesture",
    "Play",
    "Push",
    "Response",
    "Sample",
    "Stroke",
    "Surface",
    "Wander",
    "World",
    "arm",
    "arm_path",
    "grid",
    "read_stage",
    "triangles",
]
