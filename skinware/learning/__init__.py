"""Bring recorded and live touch to programs that learn: windows, tensors, images and features.

Numpy is enough for all of it; functions whose names begin with ``torch_`` need torch.
"""

from __future__ import annotations

from skinware.learning.datasets import RecordedWindows, StreamedSamples, torch_dataset, torch_iterable

__all__ = ["RecordedWindows", "StreamedSamples", "torch_dataset", "torch_iterable"]
