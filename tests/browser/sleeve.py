"""A skin with places: 640 taxels on a sleeve, whose values a test chooses, from a driver without hardware.

As a program: ``python -m tests.browser.sleeve NAME`` publishes 50 times a second until it is killed.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import numpy.typing as npt

from skinware import Structure
from skinware.geometry import Geometry
from tests.cli.fake_skin import TAXELS, FakeSkin, fake_structure

PITCH_M, RADIUS_M = 0.006, 0.1
ACROSS = 8
"""Modules beside each other, each of two rows of taxels."""
TOWARDS = np.array([0.0, -0.86, 0.51])
"""Where the sleeve looks, as does a page that nobody has turned yet."""
IDLE, PRESSED = 240, 40
"""Raw values: lower is more."""


def placed(structure: Structure) -> Structure:
    """The pressure sensors of a fake structure as a sheet that is bent about the x axis; the others have no places."""
    at = structure.index("pressure")
    n = len(structure.sensor_uid[at])
    module, taxel = np.divmod(np.arange(n), TAXELS)
    column = module % ACROSS * (TAXELS // 2) + taxel % (TAXELS // 2)
    row = module // ACROSS * 2 + taxel // (TAXELS // 2)
    angle = (row - row.mean()) * PITCH_M / RADIUS_M
    up = np.cross([1.0, 0.0, 0.0], -TOWARDS)
    normal = np.outer(np.cos(angle), TOWARDS) + np.outer(np.sin(angle), up)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position = normal * RADIUS_M + np.outer((column - column.mean()) * PITCH_M, [1.0, 0.0, 0.0])
    places = Geometry(
        type_name=np.full(n, "pressure"),
        uid=structure.sensor_uid[at],
        frame=np.full(n, "forearm"),
        position_m=position,
        normal=normal,
        radius_m=np.full(n, 0.002),
        confidence=np.full(n, np.nan),
    )
    return structure.placed(places)


class Sleeve(FakeSkin):
    """Taxels are touched one by one; all others rest.

    Args:
        name: of the driver.
        patches: of 16 modules.
    """

    def __init__(self, name: str = "sleeve", patches: int = 4) -> None:
        super().__init__(name, placed(fake_structure(patches)))
        self.taxels: npt.NDArray[np.int64] = np.arange(self.structure.n_sensors)[self.structure.index("pressure")]
        self.values = np.full(self.structure.n_sensors, 50)
        self.press()

    def press(self, *positions: int) -> None:
        """Press these sensors, and release all others; shown from the next frame on."""
        assert self.values is not None
        self.values[self.taxels] = IDLE
        self.values[list(positions)] = PRESSED

    def about(self, middle: int, within_m: float = 1.2 * PITCH_M) -> list[int]:
        """The taxels near one."""
        assert self.structure.geometry is not None
        places = self.structure.geometry.position_m
        near = np.linalg.norm(places - places[middle], axis=1) <= within_m
        return [int(i) for i in np.flatnonzero(near)]


def main() -> None:
    skin = Sleeve(sys.argv[1])
    while True:
        skin.publish()
        time.sleep(0.02)


if __name__ == "__main__":
    main()
