"""The camera: images of touch, each of the sample nearest to the moment of the call."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import numpy.typing as npt
from lerobot.cameras.camera import Camera
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_camera_skinware.configuration import SkinwareCameraConfig
from skinware import Skin
from skinware.errors import ServiceTimeout
from skinware.learning.live import ChosenSensors, LiveImage, LiveTouch
from skinware.realtime import NS_PER_S, now_ns

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
        touch = LiveTouch(
            ChosenSensors(config.type_name, tuple(config.modules), config.regions or None),
            drivers=[config.driver] if config.driver else None,
            namespace=config.namespace or None,
            max_age_s=None if config.max_age_ms is None else config.max_age_ms / 1000,
            when_stale="hold" if config.when_stale == "hold" else "raise",
        )
        x, y = config.tangential
        self._live = LiveImage(
            touch,
            int(config.height or 0),
            int(config.width or 0),
            config.colours,  # type: ignore[arg-type]  # checked by the configuration
            lowest=config.lowest,
            highest=config.highest,
            tangential=(x, y),
        )
        self._lock = threading.Lock()
        self._seen_ns = 0

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
        return self._image()

    def read_at(self, time_ns: int) -> Image:
        """Return the image nearest to a moment, for a robot that wants all of its sensors at one.

        Args:
            time_ns: the moment, CLOCK_MONOTONIC ns.
        """
        return self._image(time_ns)

    def async_read(self, timeout_ms: float = 200) -> Image:
        """Return an image of touch that is newer than the one before; wait for it.

        Args:
            timeout_ms: longest wait.
        """
        deadline_ns = now_ns() + round(timeout_ms / 1000 * NS_PER_S)
        seen_ns = self._seen_ns
        while True:
            image = self._image()
            if self._seen_ns > seen_ns or self.is_held:
                return image
            if now_ns() >= deadline_ns:
                raise TimeoutError(f"{self}: no newer touch within {timeout_ms:g} ms")
            threading.Event().wait(0.001)

    def read_latest(self, max_age_ms: int = 500) -> Image:
        """Return the image nearest to this moment, whatever was read before.

        Args:
            max_age_ms: oldest touch.
        """
        image = self._image()
        if -self.off_s * 1000 > max_age_ms:
            raise TimeoutError(f"{self}: the newest touch is {-self.off_s * 1000:.0f} ms old, not {max_age_ms} or less")
        return image

    def disconnect(self) -> None:
        """Detach from the drivers."""
        self._live.close()

    def _image(self, time_ns: int | None = None) -> Image:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        with self._lock:
            time_ns = now_ns() if time_ns is None else time_ns
            try:
                image, touch = self._live.at(time_ns)
            except ServiceTimeout as error:
                raise TimeoutError(f"{self}: {error}") from error
            self._seen_ns = int(touch.snapshot.acquired_ns.max())
            self.is_held, self.off_s = touch.is_held, (self._seen_ns - time_ns) / NS_PER_S
        return image
