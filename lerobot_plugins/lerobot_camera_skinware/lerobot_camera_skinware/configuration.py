"""Options of the camera, as a command line or a YAML file gives them."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.cameras.configs import CameraConfig


@CameraConfig.register_subclass("skinware")
@dataclass(kw_only=True)
class SkinwareCameraConfig(CameraConfig):
    """A camera that sees touch.

    Attributes:
        fps, width, height: as of every camera.
        driver: name of a driver; empty: all that run when the camera connects.
        namespace: of the driver; empty: the one of ``SKINWARE_NAMESPACE``.
        type_name: type of the sensors.
        modules: names of modules or patches, or of regions if there is a file of them; empty: all sensors.
        regions: a file of regions.
        colours: ``grey``, ``signed``, ``log`` or ``shear``.
        lowest, highest: values of the darkest and brightest colour; default: the range of the sensor type.
        tangential: types of the tangential components for ``shear``.
        max_age_ms: oldest data for ``read`` and ``async_read``; default: three periods of the driver, at least 200 ms.
        when_stale: ``raise`` a TimeoutError when the driver died or is silent, or ``hold`` the last image.
        timeout_s: longest wait for the drivers in ``connect``.
    """

    fps: int | None = 30
    width: int | None = 64
    height: int | None = 64
    driver: str = ""
    namespace: str = ""
    type_name: str = "pressure"
    modules: list[str] = field(default_factory=list)
    regions: str = ""
    colours: str = "grey"
    lowest: float | None = None
    highest: float | None = None
    tangential: list[str] = field(default_factory=lambda: ["force_x", "force_y"])
    max_age_ms: float | None = None
    when_stale: str = "raise"
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        for name, value, known in (
            ("colours", self.colours, ("grey", "signed", "log", "shear")),
            ("when_stale", self.when_stale, ("raise", "hold")),
        ):
            if value not in known:
                raise ValueError(f"{name} is {value!r}: give one of {', '.join(known)}")
        if len(self.tangential) != 2:
            raise ValueError("tangential: give two sensor types")
