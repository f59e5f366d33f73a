"""Options of the camera, as a command line or a YAML file gives them."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.cameras.configs import CameraConfig

from skinware.learning.live import TouchOptions


@CameraConfig.register_subclass("skinware")
@dataclass(kw_only=True)
class SkinwareCameraConfig(TouchOptions, CameraConfig):
    """A camera that sees touch: options of :class:`skinware.learning.live.TouchOptions`, and these.

    Attributes:
        fps, width, height: as of every camera.
        shows: the ``values`` of the taxels; or ``contacts``: of each taxel the load of the contact that it is in.
        colours: ``grey``, ``signed``, ``log`` or ``shear``.
        lowest, highest: values of the darkest and brightest colour; default: the range of the sensor type.
        tangential: types of the tangential components for ``shear``.
    """

    fps: int | None = 30
    width: int | None = 64
    height: int | None = 64
    shows: str = "values"
    colours: str = "grey"
    lowest: float | None = None
    highest: float | None = None
    tangential: list[str] = field(default_factory=lambda: ["force_x", "force_y"])

    def __post_init__(self) -> None:
        self.check(colours=("grey", "signed", "log", "shear"), shows=("values", "contacts"))
        if len(self.tangential) != 2:
            raise ValueError("tangential: give two sensor types")
