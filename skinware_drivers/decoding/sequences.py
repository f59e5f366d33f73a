"""Sequence numbers in payloads: read for whole batches, and what they skip or repeat."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.structure import Structure
from skinware_drivers.numbering import SequenceNumber

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

_NONE_YET = -1


def read_numbers(payload: Bytes, sequence: SequenceNumber) -> Indices:
    """(n,) the sequence number in each of n payloads.

    Args:
        payload: (n, size) uint8.
        sequence: where it is.
    """
    word = np.ascontiguousarray(payload[:, sequence.offset : sequence.end]).view(sequence.dtype)[:, 0]
    if sequence.mask is not None:
        word = (word & word.dtype.type(sequence.mask)) >> word.dtype.type(sequence.shift)
    plain: Indices = word.astype(np.int64)
    return plain


class Sequences:
    """The last sequence number of every module.

    Args:
        structure: the skin.
    """

    def __init__(self, structure: Structure) -> None:
        self._module_patch = structure.module_patch.astype(np.intp)
        self._n_patches = structure.n_patches
        self.last = np.full(structure.n_modules, _NONE_YET, np.int64)

    def compare(self, sequence: SequenceNumber, payload: Bytes, module: Indices) -> tuple[Indices, Indices, Indices]:
        """Compare the numbers of frames with those before them.

        Args:
            sequence: where the numbers are.
            payload: (n, size) uint8.
            module: (n,) module of each.

        Returns:
            For every patch, (n_patches,) each: how many numbers were skipped, came again, and went back.
        """
        order = np.argsort(module, kind="stable")
        module, number = module[order], read_numbers(payload, sequence)[order]
        before = np.empty_like(number)
        before[1:] = number[:-1]
        first = np.flatnonzero(np.append(True, module[1:] != module[:-1])) if len(module) else module
        before[first] = self.last[module[first]]
        step = (number - before) % sequence.turn
        step[before == _NONE_YET] = 1
        self.last[module] = number
        is_back = step > sequence.turn // 2
        skipped = np.where(is_back, 0, np.maximum(step - 1, 0))
        return self._by_patch(module, skipped), self._by_patch(module, step == 0), self._by_patch(module, is_back)

    def forget(self, patch: int) -> None:
        self.last[self._module_patch == patch] = _NONE_YET

    def _by_patch(self, module: Indices, count: Indices | npt.NDArray[np.bool_]) -> Indices:
        found = np.bincount(self._module_patch[module], weights=count, minlength=self._n_patches)
        return found.astype(np.int64)
