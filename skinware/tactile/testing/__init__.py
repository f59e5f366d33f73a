"""Simulate a skin with places, somebody who presses it, and the faults of real skins, as a truth to test against.

It gives arrays, so that an algorithm can be compared with the load that no real skin knows: docs/tactile/world.md.
"""

from skinware.tactile.testing.gestures import Cover, Gesture, Play, Push, Response, Stroke, Wander, read_stage
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
