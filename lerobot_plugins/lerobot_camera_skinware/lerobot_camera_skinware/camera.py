"""The camera: images of touch, each of the sample nearest to the moment of the call."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from lerobot.cameras.camera import Camera
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_camera_skinware.configuration import SkinwareCameraConfig
from skinware import Skin
from skinware.errors import ServiceTimeout
from skinware.learning import LiveImage, TouchSample
from skinware.realtime import now_ns

Image = npt.NDArray[np.uint8]


class SkinwareCamera(Camera):
    """A camera whose images are touch; threads may share it.

    Attributes:
        is_held: the last image was held because no newer touch came (``when_stale: hold``).
        off_s: time of the touch in the last image minus that of its call, s.

    Raises:
        TimeoutError: from all reads: a driver died, is silent, or came back with other sensors.
        DeviceNotConnectedError: from all reads: before ``connect``.
    """

    def __init__(self, config: SkinwareCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.is_held, self.off_s = False, 0.0
        x, y = config.tangential
        self._live = LiveImage(
            config.touch(with_contacts=config.shows == "contacts"),
            int(config.height or 0),
            int(config.width or 0),
            config.colours,  # type: ignore[arg-type]  # checked by the configuration
            lowest=config.lowest,
            highest=config.highest,
            tangential=(x, y),
            shows="contacts" if config.shows == "contacts" else "values",
        )
        self._lock = threading.Lock()

    def __str__(self) -> str:
        return f"SkinwareCamera({self.config.driver or 'all drivers'}, {self.config.type_name})"

    @property
    def is_connected(self) -> bool:
        """Whether it is connected; the driver may be silent all the same."""
        return self._live.touch.is_open

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return an entry for each type of each driver that runs in the namespace of ``SKINWARE_NAMESPACE``."""
        with Skin() as skin:
            layout = skin.refresh()
        return [
            {
                "name": f"{driver}: {each.name}",
                "type": "skinware",
                "id": driver,
                "driver": driver,
                "type_name": each.name,
            }
            for driver, structure in zip(layout.drivers, layout.structures, strict=True)
            for each in structure.types
        ]

    def connect(self, warmup: bool = True) -> None:
        """Attach to the drivers.

        Raises:
            ConnectionError: they do not run, or lack such sensors.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        try:
            self._live.open(timeout_s=self.config.timeout_s)
            if warmup:
                self.read()
        except Exception as error:
            self.disconnect()
            raise ConnectionError(f"{self}: {error}") from error

    def read(self) -> Image:
        """Return the image nearest to this moment; wait half a period of the driver for it at most."""
        return self.read_at(now_ns())

    def read_at(self, time_ns: int) -> Image:
        """Return the image nearest to a moment, for a robot that wants all of its sensors at one.

        Args:
            time_ns: the moment, CLOCK_MONOTONIC ns.
        """
        return self._image(lambda: self._live.at(time_ns))

    def async_read(self, timeout_ms: float = 200) -> Image:
        """Return an image of touch that is newer than the one before; wait for it.

        Args:
            timeout_ms: longest wait.
        """
        return self._image(lambda: self._live.newer(timeout_s=timeout_ms / 1000))

    def read_latest(self, max_age_ms: int = 500) -> Image:
        """Return the image nearest to this moment, whatever was read before.

        Args:
            max_age_ms: oldest touch.
        """
        image = self.read()
        if -self.off_s * 1000 > max_age_ms:
            raise TimeoutError(f"{self}: the newest touch is {-self.off_s * 1000:.0f} ms old, not {max_age_ms} or less")
        return image

    def disconnect(self) -> None:
        """Detach from the drivers."""
        self._live.close()

    def _image(self, take: Callable[[], tuple[Image, TouchSample]]) -> Image:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        with self._lock:
            try:
                image, touch = take()
            except ServiceTimeout as error:
                raise TimeoutError(f"{self}: {error}") from error
            self.is_held, self.off_s = touch.is_held, touch.off_s
        return image
