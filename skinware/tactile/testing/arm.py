"""A forearm and a hand covered with ROBOSKIN triangles: the demo geometry, and somewhere to press."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.tactile.testing.surface import CHANNELS_M, SIDE_M, TRIANGLE_M, Surface

ArrayF = npt.NDArray[np.float64]

TRIANGLES = 16
"""On each board."""
ARM_FRAME = "arm"
"""Whose axes positions are in: x from the elbow to the fingertips, z up."""

_HEIGHT_M = SIDE_M * np.sqrt(0.75)
_FACES = 6
_AXIS_TO_FACE_M = _HEIGHT_M / 2 / np.tan(np.pi / _FACES)
_WRIST_M, _HALF_HAND_M = 0.16, 0.0125
_BETWEEN_ARMS_M = 0.25
_PARTS = 4
_HAND = 3
_HAND_STRIP = 4
_TOURS = ((*range(8), *range(15, 7, -1)), (0, 1, 2, 3, 7, 6, 5, 4, 8, 9, 10, 11, 15, 14, 13, 12))


def arm(boards: Sequence[int] = (0, 1, 2, 3), *, pads: bool = False) -> Surface:
    """Boards of 16 triangles on a forearm (boards 0 to 2) and a hand (board 3); 4 to 7 are another arm beside it.

    The forearm is a prism of six faces, 135 mm long and 52 mm wide; each board covers two of them with a strip of
    eight triangles each. The hand has two strips of four on its palm (triangles 0 to 7) and two on its back. Patches
    are the boards in their order, modules their triangles.

    Args:
        boards: their numbers; below 0 they are on arms on the other side.
        pads: with the thermal pads: 12 sensors a triangle instead of 10.
    """
    flat = CHANNELS_M if pads else TRIANGLE_M
    parts = [_triangle(board, triangle, flat) for board in boards for triangle in range(TRIANGLES)]
    module = np.repeat(np.arange(len(parts)), len(flat))
    return Surface(
        np.concatenate([position for position, _ in parts]),
        np.repeat([normal for _, normal in parts], len(flat), axis=0),
        module,
        module // TRIANGLES,
    )


def arm_path(board: int) -> ArrayF:
    """(16, 3) the middles of a board's triangles in the order of a closed walk over all of them, m."""
    middle = np.zeros((1, 2))
    tour = _TOURS[board % _PARTS == _HAND]
    return np.concatenate([_triangle(board, triangle, middle)[0] for triangle in tour])


def _triangle(board: int, triangle: int, flat: npt.NDArray[np.float64]) -> tuple[ArrayF, ArrayF]:
    """(k, 3) where points of a triangle are, given (k, 2) in its plane; and its normal."""
    number, part = divmod(board, _PARTS)
    if part == _HAND:
        strip, along = divmod(triangle, _HAND_STRIP)
        up = -1.0 if strip < 2 else 1.0  # the palm is below
        normal = np.array([0.0, 0.0, up])
        centre = np.array([_WRIST_M, 0, 0]) + _HALF_HAND_M * normal
        across_m = (strip % 2 - 0.5) * _HEIGHT_M
    else:
        face, along = divmod(triangle, TRIANGLES // 2)
        angle = (2 * part + face) * (2 * np.pi / _FACES)
        normal = np.array([0.0, np.cos(angle), np.sin(angle)])
        centre = _AXIS_TO_FACE_M * normal
        across_m = 0.0
    u = np.array([1.0, 0.0, 0.0])
    v = np.cross(normal, u)
    turned = -1 if triangle % 2 else 1
    x = turned * flat[:, 0] + (along + 1) * SIDE_M / 2
    y = turned * flat[:, 1] + across_m - turned * _HEIGHT_M / 6
    position = centre + x[:, np.newaxis] * u + y[:, np.newaxis] * v
    position[:, 1] += number * _BETWEEN_ARMS_M
    return position, normal
