"""Bring recorded and live touch to programs that learn: windows, tensors, images and features.

Numpy is enough for all of it; functions whose names begin with ``torch_`` need torch, recordings the extra ``record``.
"""

from typing import TYPE_CHECKING

from skinware.learning.features import Totals, contact_numbers, points, slip, spectrogram
from skinware.learning.images import Colours, LiveImage, TouchImage
from skinware.learning.live import ChosenSensors, LiveTouch, TouchSample
from skinware.learning.model_service import ModelService, onnx_model

if TYPE_CHECKING:
    from skinware.learning.datasets import RecordedWindows, StreamedSamples, torch_dataset, torch_iterable

__all__ = [
    "ChosenSensors",
    "Colours",
    "LiveImage",
    "LiveTouch",
    "ModelService",
    "RecordedWindows",
    "StreamedSamples",
    "Totals",
    "TouchImage",
    "TouchSample",
    "contact_numbers",
    "onnx_model",
    "points",
    "slip",
    "spectrogram",
    "torch_dataset",
    "torch_iterable",
]


def __getattr__(name: str) -> object:
    if name in __all__:  # of recordings, which need packages that live touch does not
        from skinware.learning import datasets

        return getattr(datasets, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
