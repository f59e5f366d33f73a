"""Which taxels of which device are on which body of a scene: a file in TOML, as docs/how-to/simulate.md explains."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec

from skinware.errors import ConfigurationError
from skinware.toml_text import TomlText
from skinware_drivers.virtual.physics.transfer import TransferSettings

FORMAT, VERSION = "skinware-binding", 1
SCENES = Path(__file__).parent / "scenes"

Triple = tuple[float, float, float]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=1, le=4096)]


class ModuleBinding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Taxels on a body."""

    body: str
    name: str = ""
    device: int = 1
    first: Annotated[int, msgspec.Meta(ge=0)] | None = None
    axes: Annotated[str, msgspec.Meta(pattern="^[-xyz]+$")] = "z"
    rows: _Count | None = None
    columns: _Count = 1
    pitch_m: tuple[_Positive, _Positive] = (0.003, 0.003)
    at_m: Triple = (0.0, 0.0, 0.0)
    x: Triple = (1.0, 0.0, 0.0)
    y: Triple = (0.0, 1.0, 0.0)
    arm_board: int | None = None
    geometry: str = ""
    uid: tuple[int, int] = (0, (1 << 64) - 1)
    reach_m: _Positive | None = None
    transfer: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if (self.rows is not None) + bool(self.geometry) + (self.arm_board is not None) != 1:
            raise ValueError(f"module on {self.body}: give either rows, a geometry or an arm_board")


class Move(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A movement of a scene to a pose, as long as it takes."""

    at_s: Annotated[float, msgspec.Meta(ge=0)]
    pose: str
    seconds: Annotated[float, msgspec.Meta(ge=0)] = 0.5


class Binding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    format: str
    version: int
    module: tuple[ModuleBinding, ...]
    scene: str = ""
    transfer: dict[str, Any] = {}
    pose: dict[str, dict[str, float]] = {}
    move: tuple[Move, ...] = ()
    repeat_s: _Positive | None = None
    carrier: str = ""


class Bound(msgspec.Struct, frozen=True):
    binding: Binding
    file: Path
    scene: Path

    def settings(self, module: ModuleBinding) -> TransferSettings:
        try:
            return msgspec.convert({**self.binding.transfer, **module.transfer}, TransferSettings)
        except msgspec.ValidationError as error:
            raise ConfigurationError(
                f"{self.file}: transfer of module {module.name or module.body!r}: {error}"
            ) from None


def find_binding(world: str, driver: str) -> Bound:
    """Find the binding of a world for the devices of a driver.

    Args:
        world: ``mujoco:NAME`` of a scene of ours, ``mujoco:SCENE.xml`` or ``mujoco:BINDING.toml``. The binding of a
            scene is ``SCENE.DRIVER.toml`` beside it, or ``FOLDER.DRIVER.toml`` among ours.
    """
    kind, _, name = world.partition(":")
    if kind != "mujoco" or not name:
        raise ConfigurationError(f"option world={world}: give mujoco:SCENE.xml, or mujoco: and one of {_shipped()}")
    given = Path(name).expanduser()
    if given.suffix == ".toml":
        return _read(given, None)
    scene = given if given.suffix == ".xml" else SCENES / f"{name}.xml"
    candidates = [scene.with_suffix(f".{driver}.toml"), SCENES / f"{scene.absolute().parent.name}.{driver}.toml"]
    for file in candidates:
        if file.exists():
            return _read(file, scene)
    if not scene.exists():
        raise ConfigurationError(f"option world={world}: no such scene; there are {_shipped()}, or a file SCENE.xml")
    raise ConfigurationError(f"option world={world}: {candidates[0]} is missing, which binds {driver} to the scene")


def _read(file: Path, scene: Path | None) -> Bound:
    binding = TomlText(file).of_format("binding", FORMAT, VERSION, Binding)
    scene = scene or file.parent / binding.scene
    if not scene.is_file():
        raise ConfigurationError(f"{file}: the scene {scene} does not exist; it is a file of MuJoCo (MJCF)")
    for number, move in enumerate(binding.move):
        if move.pose not in binding.pose:
            raise ConfigurationError(f"{file}: move {number + 1}: there is no pose {move.pose!r}")
    return Bound(binding, file, scene)


def _shipped() -> str:
    return ", ".join(sorted(path.stem for path in SCENES.glob("*.xml")))
