"""Two strokes over a matrix tell how its taxels lie, however fast the finger goes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware_drivers.proving.strokes import Matrix, judge

Floats = npt.NDArray[np.float64]
MATRIX = Matrix(5, 4)
THRESHOLD = 8.0


def stroke(matrix: Matrix, axis: int, seed: int = 0) -> Floats:
    """(frames, n): a finger goes over rows (axis 0) or columns, now slowly, now fast, at an angle, with noise."""
    random = np.random.default_rng([seed, axis])
    speed = 0.04 + 0.03 * np.sin(np.linspace(0, 5, 400))
    at = np.cumsum(speed) - 2
    at = at[at < matrix[axis] + 1]
    along, beside = matrix.places[:, axis], matrix.places[:, 1 - axis]
    distance = at[:, np.newaxis] - along - 0.05 * beside
    strength = random.uniform(60, 200, len(along))
    answer = strength * np.exp(-(distance**2) / 0.5)
    return np.asarray(np.abs(answer + random.normal(0, 1, answer.shape)))


def judged(matrix: Matrix, wiring: npt.NDArray[np.int64], seed: int = 0) -> tuple[list[str], list[str]]:
    """What is found where place ``i`` of the driver shows the taxel ``wiring[i]``."""
    down, across = stroke(matrix, 0, seed)[:, wiring], stroke(matrix, 1, seed)[:, wiring]
    order = judge(matrix, down, across, THRESHOLD)
    assert order.silent == []
    return list(order.wrong), list(order.misplaced)


def grid(matrix: Matrix) -> npt.NDArray[np.int64]:
    return np.arange(matrix.rows * matrix.columns).reshape(matrix)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("matrix", [MATRIX, Matrix(4, 6), Matrix(8, 4), Matrix(16, 16), Matrix(3, 3)])
def test_nothing_is_found_where_nothing_is_wrong(matrix: Matrix, seed: int) -> None:
    assert judged(matrix, grid(matrix).ravel(), seed) == ([], [])


@pytest.mark.parametrize("seed", range(8))
def test_two_taxels_that_are_exchanged(seed: int) -> None:
    wiring = grid(MATRIX).ravel().copy()
    one, other = np.random.default_rng(seed).choice(20, 2, replace=False).tolist()
    wiring[[one, other]] = wiring[[other, one]]
    words = [f"taxels {min(one, other)} and {max(one, other)} are exchanged"]
    assert judged(MATRIX, wiring, seed) == ([], words)


def test_mirrored_rows_and_columns() -> None:
    rows, columns = (f"{name} are mirrored: the last comes first" for name in ("rows", "columns"))
    assert judged(MATRIX, grid(MATRIX)[::-1].ravel()) == ([rows], [])
    assert judged(MATRIX, grid(MATRIX)[:, ::-1].ravel()) == ([columns], [])
    assert judged(MATRIX, grid(MATRIX)[::-1, ::-1].ravel()) == ([rows, columns], [])


def test_exchanged_taxels_of_a_mirrored_matrix() -> None:
    wiring = grid(MATRIX)[::-1].ravel().copy()
    wiring[[2, 17]] = wiring[[17, 2]]
    wrong, misplaced = judged(MATRIX, wiring)
    assert len(wrong) == 1
    assert misplaced == ["taxels 2 and 17 are exchanged"]


def test_rows_and_columns_that_are_exchanged() -> None:
    square = Matrix(4, 4)
    assert judged(square, grid(square).T.ravel()) == (["rows and columns are exchanged"], [])


def test_rows_of_another_length() -> None:
    """The device has four rows of six, and the driver says six of four."""
    right, said = Matrix(4, 6), Matrix(6, 4)
    down, across = stroke(right, 0), stroke(right, 1)
    (words,) = judge(said, down, across, THRESHOLD).wrong
    assert "4 rows of 6, not 6 rows of 4" in words


def test_taxels_in_no_order() -> None:
    wiring = np.random.default_rng(3).permutation(20)
    (words,) = judged(MATRIX, wiring)[0]
    assert "in no order" in words


def test_a_column_of_which_the_finger_goes_the_other_way() -> None:
    column = Matrix(8, 1)
    down = stroke(column, 0)
    assert judge(column, down, down, THRESHOLD).wrong == []
    assert judge(column, down[:, ::-1], down, THRESHOLD).wrong == ["rows are mirrored: the last comes first"]


def test_dead_taxels_are_silent_and_in_nobodys_way() -> None:
    down, across = stroke(MATRIX, 0), stroke(MATRIX, 1)
    down[:, [3, 4]] = across[:, [3, 4]] = 1
    order = judge(MATRIX, down, across, THRESHOLD)
    assert (order.wrong, order.misplaced, order.silent, order.judged) == ([], [], [3, 4], 18)


def test_no_stroke_at_all() -> None:
    nothing = np.zeros((0, 20))
    order = judge(MATRIX, nothing, nothing, THRESHOLD)
    assert (order.wrong, order.misplaced, order.judged) == ([], [], 0)
    assert len(order.silent) == 20


@pytest.mark.parametrize(
    ("kind", "count", "matrix"),
    [("4x6", 24, Matrix(4, 6)), ("8x1", 8, Matrix(8, 1)), ("4x6", 23, None), ("triangle", 10, None), ("1x1", 1, None)],
)
def test_the_matrix_of_a_kind(kind: str, count: int, matrix: Matrix | None) -> None:
    assert Matrix.of_kind(kind, count) == matrix
