from __future__ import annotations

import pytest

from skinware.views.scene import block_columns, shape_of


def drawn(kind: str, count: int) -> list[str]:
    """A module as text: two characters a sensor, its number in base 16."""
    shape = shape_of(kind, count)
    rows = [[" "] * shape.halves for _ in range(shape.rows)]
    for number, (row, half) in enumerate(shape.cells):
        rows[row][half : half + 2] = [f"{number:x}", f"{number:x}"]
    return ["".join(row).rstrip() for row in rows]


def test_a_triangle_of_ten_taxels_is_one() -> None:
    """Channels 0 to 5, 7 to 9 and 11 are its taxels; 9 is the tip, as in the published positions of an iCub."""
    assert drawn("triangle", 10) == ["   88", "  7799", " 663300", "55442211"]


def test_a_fingertip_is_one() -> None:
    assert drawn("fingertip", 12) == ["    bb", "  8899aa", "  776655", "4400112233"]


@pytest.mark.parametrize(
    ("kind", "count", "rows", "columns"),
    [
        ("3x2", 6, 3, 2),
        ("2x3", 6, 2, 3),
        ("2x3", 4, 2, 2),
        ("triangle", 2, 1, 2),
        ("fingertip", 16, 4, 4),
        ("", 1, 1, 1),
    ],
)
def test_rows_and_columns(kind: str, count: int, rows: int, columns: int) -> None:
    shape = shape_of(kind, count)
    assert (shape.rows, shape.halves) == (rows, 2 * columns)
    assert shape.cells == tuple((n // columns, 2 * (n % columns)) for n in range(count))


@pytest.mark.parametrize(
    ("count", "columns"), [(1, 1), (2, 2), (4, 2), (7, 4), (10, 5), (12, 4), (16, 4), (192, 16), (256, 16)]
)
def test_blocks_are_compact(count: int, columns: int) -> None:
    assert block_columns(count) == columns
