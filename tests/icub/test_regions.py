"""Body parts as regions: by the names of boards where a board is theirs alone, otherwise by uid."""

from __future__ import annotations

from skinware.tactile.regions import Region
from skinware_drivers.icub.body import Place, regions_of


def board(patch: int, number: int, triangles: range = range(16)) -> set[Place]:
    return {(patch, number, triangle) for triangle in triangles}


def test_boards_of_their_own_are_named() -> None:
    hand, arm = board(2, 14), board(2, 9) | board(2, 8)
    enabled = (hand | arm) - board(2, 9, range(4, 16))
    assert regions_of("left", {"hand": hand, "arm": arm, "head": board(2, 3)}, enabled, [2]) == [
        Region("hand", "pressure", ("left",), patch=("board 14",)),
        Region("arm", "pressure", ("left",), patch=("board 8", "board 9")),
    ]


def test_of_a_shared_board_the_sensors_are_named() -> None:
    upper, lower = board(1, 4, range(2)), board(1, 4, range(2, 3)) | board(1, 5)
    found = regions_of("leg", {"upper": upper, "lower": lower}, upper | lower, [1])
    assert found[0].patch == ()
    assert found[0].uid == tuple(4 << 16 | triangle << 8 | channel for triangle in range(2) for channel in range(12))
    assert found[1].patch == ("board 5",)
    assert found[1].uid == tuple(4 << 16 | 2 << 8 | channel for channel in range(12))


def test_boards_of_one_address_on_two_buses_are_told_apart() -> None:
    left, right = board(1, 7, range(1)), board(2, 7, range(1))
    found = regions_of("leg", {"left": left, "right": right}, left | right, [2, 1])
    assert [region.patch for region in found] == [(), ()]
    assert [min(region.uid) for region in found] == [1 << 32 | 7 << 16, 7 << 16]
