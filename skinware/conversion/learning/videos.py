"""Write images as videos with the settings of LeRobot's encoder: AV1 in MP4, a key frame at each second image."""

from __future__ import annotations

import os
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

from skinware.conversion.tables import package
from skinware.errors import ConfigurationError

_ENCODER, _PIXELS = "libsvtav1", "yuv420p"
_OPTIONS = {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "fast-decode=0"}
"""Defaults of huggingface/lerobot v0.6.1, lerobot/configs/video.py."""
_LEAST = 16
"""Pixels of the shortest side that the encoder was seen to take."""


class Video:
    """The video of one feature in one episode.

    Args:
        shape: height, width and channels of the images.
    """

    def __init__(self, path: Path, fps: int, shape: tuple[int, ...]) -> None:
        self._av, self._images = package("av", "a data set with videos"), package("PIL.Image", "a data set with videos")
        height, width = shape[:2]
        if height % 2 or width % 2 or min(height, width) < _LEAST:
            raise ConfigurationError(f"videos of {width} x {height}: give even sizes of at least {_LEAST}")
        self.info = {
            "video.height": height,
            "video.width": width,
            "video.codec": "av1",
            "video.pix_fmt": _PIXELS,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }
        os.environ.setdefault("SVT_LOG", "1")  # the encoder prints its settings otherwise
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._av.open(str(path), "w")
        self._stream = self._file.add_stream(_ENCODER, fps, options=_OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, _PIXELS

    def add(self, pngs: Iterable[bytes]) -> None:
        for png in pngs:
            with self._images.open(BytesIO(png)) as image:
                self._mux(self._av.VideoFrame.from_image(image))

    def close(self) -> None:
        """Write what the encoder still holds."""
        self._mux(None)
        self._file.close()

    def _mux(self, frame: Any) -> None:
        self._file.mux(self._stream.encode(frame))
