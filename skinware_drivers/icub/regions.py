"""The body parts of a skin device as regions: a port of its wrapper is a named part of the skin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from skinware.tactile.regions import Region
from skinware_drivers.can.roboskin_options import CHANNELS
from skinware_drivers.icub.body import Place


def regions_of(
    driver: str, places: Mapping[str, set[Place]], enabled: set[Place], patches: Sequence[int]
) -> list[Region]:
    """A region for each body part of which something is switched on.

    Args:
        driver: name of the driver of the device.
        places: the triangles of each body part, by its name.
        enabled: triangles that are switched on.
        patches: the device's patches, in the order of the driver's buses.
    """
    boards = Counter(board for _, board in {(patch, board) for patch, board, _ in enabled})
    regions = []
    for name, of_part in places.items():
        on = of_part & enabled
        by_name, by_uid = set[int](), list[int]()
        for patch, board, triangle in sorted(on):
            of_board = {place for place in enabled if place[:2] == (patch, board)}
            if boards[board] == 1 and of_board <= on:
                by_name.add(board)
            else:  # the name is not the board's alone, or the board not the part's
                first = patches.index(patch) << 32 | board << 16 | triangle << 8
                by_uid += range(first, first + CHANNELS)
        if on:
            patch_names = tuple(f"board {board}" for board in sorted(by_name))
            regions.append(Region(name, "pressure", (driver,), tuple(by_uid), patch_names))
    return regions
