"""Run each sensor type of a driver through a chain of stages, which a TOML file lists in their order.

docs/tactile/baselines.md has examples of the file; the keys of a stage are its settings.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.native import give_arrays
from skinware.sensor_types import NOT_TOUCH
from skinware.structure import Structure
from skinware.tactile.arrays import Arrays, Bytes, Floats, part_of
from skinware.tactile.baseline import SHOWN, UNUSABLE, Baseline, BaselineSettings, Calm
from skinware.tactile.curves import TEMPERATURE, CurveSettings, CurveStage, temperature_of
from skinware.tactile.stages import STRUCTS, AmplifierSettings, FilterSettings, ScalerSettings, Signal, Stage, Taxels
from skinware.tactile.thermal import ThermalSettings
from skinware.tactile.vectors import FieldSettings, VectorSettings, VectorStage, vectors_of
from skinware.toml_text import TomlText

_calls = native.core().quick
_begin, _end, _calm = _calls.skinware_chain_begin, _calls.skinware_chain_end, _calls.skinware_chain_calm
for _call in (_begin, _end):
    _call.argtypes, _call.restype = (ctypes.c_void_p,), None
_calm.argtypes, _calm.restype = (*(ctypes.c_void_p,) * 2, ctypes.c_int64, *(ctypes.c_void_p,) * 2), None


class BaselineStageSettings(BaselineSettings, frozen=True, kw_only=True, tag_field="stage", tag="baseline"):
    """Settings of a baseline as a stage: 0 = no touch; the unit stays.

    Attributes:
        types: the sensor types that it is for; None: all for which it can be made.
    """

    types: tuple[str, ...] | None = None

    def stage(self, taxels: Taxels) -> BaselineStage:
        name, unit = taxels.type.name, taxels.type.unit
        if name.startswith(NOT_TOUCH):
            raise ConfigurationError(f"a {name} has no rest to return to")
        if name == "proximity" and unit == "m":
            raise ConfigurationError(
                "a proximity in m falls when something comes near; baselines are for rising values"
            )
        given = {field: getattr(self, field) for field in BaselineSettings.__struct_fields__}
        return BaselineStage(taxels, BaselineSettings(**given))


class BaselineStage(Stage):
    """Takes the baselines of n taxels away.

    Attributes:
        baseline: the baselines.
        before: the taxels as they come in.
        given: (n,) float32, the values of the newest sample as they came in; the next one overwrites them.
        shown: the same, calmed, in arrays that the next sample overwrites.
        calm: ``shown``; None before the first sample.
    """

    name = "baseline"

    def __init__(self, taxels: Taxels, settings: BaselineSettings) -> None:
        self.before = taxels
        before = taxels.type
        span = before.maximum - before.minimum
        calmed = replace(before, minimum=-span if taxels.signed else 0.0, maximum=span)
        super().__init__(replace(taxels, type=calmed, resolution=0.0))
        self.baseline = Baseline(
            taxels.module,
            taxels.patch,
            settings,
            resolution=taxels.resolution,
            signed=taxels.signed,
            common=taxels.common,
            limits=(before.minimum, before.maximum),
        )
        self.given: Floats = np.full(len(taxels), np.nan, np.float32)
        self.calm: Calm | None = None
        memory = np.zeros(SHOWN * len(taxels), np.uint8)
        self.shown = Calm.of(memory)
        self._to = self.given.ctypes.data, memory.ctypes.data

    def step(self, signal: Signal) -> None:
        _calm(self.baseline.at, signal.at, signal.time_ns, *self._to)
        self.calm = self.shown


FORMAT, VERSION = "skinware-chain", 1

AnySettings = (
    BaselineStageSettings
    | CurveSettings
    | FilterSettings
    | ScalerSettings
    | AmplifierSettings
    | FieldSettings
    | VectorSettings
    | ThermalSettings
)


class ChainSettings:
    """The settings of the stages of a chain, in their order; ``place`` gives file and line of a stage, for messages."""

    def __init__(
        self, stages: Sequence[AnySettings], place: Callable[[int], str] = lambda number: f"stage {number + 1}"
    ) -> None:
        self.stages = tuple(stages)
        self._place = place

    @classmethod
    def calm(cls) -> Self:
        """Return the settings of a baseline and nothing else."""
        return cls([BaselineStageSettings()])

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the settings from a file.

        Raises:
            ConfigurationError: not there, not TOML, not of this format, or a wrong value; the message says where.
        """
        path = Path(path)
        text = TomlText(path)
        stages: tuple[AnySettings, ...] = text.entries("chain", FORMAT, VERSION, "stage", AnySettings)
        if not stages:
            raise ConfigurationError(f"{path}: no [[stage]] in it")
        found = [
            msgspec.structs.replace(stage, file=str(path.parent / stage.file))
            if isinstance(stage, CurveSettings)
            else stage
            for stage in stages
        ]
        return cls(found, lambda number: text.place(("stage", number)))

    def chain(self, structure: Structure) -> Chain:
        """Make the chain for a driver.

        Raises:
            ConfigurationError: a stage cannot be made for a type that it names, or for none; the message says why.
        """
        taxels = {sensor_type.name: Taxels.of(structure, sensor_type.name) for sensor_type in structure.types}
        steps: list[tuple[Stage, tuple[str, ...]]] = []
        for number, settings in enumerate(self.stages):
            refused, tag = [], settings.__struct_config__.tag
            wanted = taxels if settings.types is None else settings.types
            for name in wanted:
                if name not in taxels:
                    raise ConfigurationError(
                        f"{self._place(number)}: no sensor type {name!r}; there are: {', '.join(taxels)}"
                    )
            groups = _groups(settings, taxels, wanted)
            for names in groups:
                try:
                    stage = settings.stage(*(taxels[name] for name in names))
                except ConfigurationError as error:
                    refused.append(f"{tag}: {error}")
                    if settings.types is not None:
                        raise ConfigurationError(f"{self._place(number)}: {refused[-1]}") from None
                else:
                    steps.append((stage, names))
                    taxels |= zip(names, stage.axes, strict=True)
            if len(refused) == len(groups):
                why = "; ".join(refused) or f"{tag}: {_WHY_NO_GROUPS[type(settings)]}"
                raise ConfigurationError(f"{self._place(number)}: {why}")
        return Chain(structure, steps, taxels)


_WHY_NO_GROUPS: dict[type, str] = {
    ThermalSettings: f"it needs sensors of type {TEMPERATURE}, and others that have a rest",
    FieldSettings: "no three types in one unit are the axes of the same taxels",
    VectorSettings: "no three types in one unit are the axes of the same taxels",
}


def _groups(settings: AnySettings, taxels: Mapping[str, Taxels], wanted: Iterable[str]) -> list[tuple[str, ...]]:
    """The types that a stage changes together, for each time that it is made."""
    if isinstance(settings, FieldSettings | VectorSettings):
        return [names for names in vectors_of(taxels) if set(names) <= set(wanted)]
    if isinstance(settings, ThermalSettings):
        return [(name, TEMPERATURE) for name in wanted if TEMPERATURE in taxels and not name.startswith(NOT_TOUCH)]
    return [(name,) for name in wanted]


HEALTH = "health/"
"""Beginning of the names of arrays of health in a state."""


@dataclass(frozen=True, eq=False)
class ChainState:
    """The knowledge that a chain has gained.

    Attributes:
        fingerprint: of the values that its baselines saw.
        arrays: ``TYPE/NAME`` of :meth:`.Baseline.state`, ``health/TYPE/NAME`` of :meth:`.Health.state`, and the ``uid``
            of both.
    """

    fingerprint: str
    arrays: Arrays


class Learning(Protocol):
    """Learns of n taxels: a baseline, a stage, health."""

    def state(self) -> Arrays: ...
    def restore(self, state: Arrays, rows: npt.NDArray[np.intp]) -> int | None: ...


class Chain:
    """All stages of a driver.

    Attributes:
        structure: structure of the output: the same sensors, float32, with the units of the last stages.
        stages: by type.
        baseline_stages, curve_stages: by type, the first stage that is a baseline, and the last that is a curve.
        output, flags: (n_sensors,) float32 and uint8, values and status of the newest sample; the next overwrites them.
        at: address of its ``struct chain``, for C.
        vectors: the types that are axes of vectors, for each stage that shows vectors.
    """

    def __init__(
        self, structure: Structure, steps: list[tuple[Stage, tuple[str, ...]]], taxels: dict[str, Taxels]
    ) -> None:
        self.stages = {name: [stage for stage, names in steps if name in names] for name in taxels}
        self.baseline_stages: dict[str, BaselineStage] = {}
        self.curve_stages: dict[str, CurveStage] = {}
        for name, stages in self.stages.items():
            for stage in stages:
                if isinstance(stage, BaselineStage):
                    self.baseline_stages.setdefault(name, stage)
                elif isinstance(stage, CurveStage):
                    self.curve_stages[name] = stage
        for *within, normal in vectors_of({name: stage.before for name, stage in self.baseline_stages.items()}):
            for name in within if not self.baseline_stages[normal].before.signed else ():
                self.baselines[name].stand_beside(self.baselines[normal])
        self._learning: list[tuple[str, Learning, str, str]] = []
        for name, baseline in self.baselines.items():
            self.keep(name, baseline, f"{name}/")
            for stage in self.stages[name]:
                if stage.taxels.type.name == name:  # others only read it
                    self.keep(name, stage, f"{name}/", f"{stage.name}.")
        self.vectors = [names for stage, names in steps if isinstance(stage, VectorStage)]
        self._before = structure
        self._signals = {name: Signal(structure.index(name)) for name, stages in self.stages.items() if stages}
        self._steps = [(stage, [self._signals[name] for name in names]) for stage, names in steps]
        self._warm = [stage for stage in self.curve_stages.values() if stage.table.warms]
        self.output: Floats = np.zeros(structure.n_sensors, np.float32)
        self.flags: Bytes = np.zeros(structure.n_sensors, np.uint8)
        signals = np.array([signal.at for signal in self._signals.values()], np.uint64)
        self._kept = words, _ = STRUCTS["Chain"](), signals
        given: Arrays = {"values": self.output, "status": self.flags, "signals": signals}
        words.n, words.n_signals = structure.n_sensors, len(signals)
        give_arrays(words, 0, {}, given)
        self.at: int = ctypes.addressof(words)
        types = [replace(taxels[t.name].type, scale=1.0, offset=0.0) for t in structure.types]
        self.structure: Structure = structure.replace(types=types, dtype=np.float32)

    def keep(self, type_name: str, learning: Learning, group: str, name: str = "") -> None:
        """Let the state have what is learned of a type: arrays whose names begin with ``group`` and ``name``."""
        self._learning.append((type_name, learning, group, name))

    def state(self) -> ChainState:
        """Return all that was learned."""
        found: Arrays = {}
        for type_name, learning, group, name in self._learning:
            found[f"{group}uid"] = self.uid(type_name)
            found |= {f"{group}{name}{key}": array for key, array in learning.state().items()}
        return ChainState(self._fingerprint, found)

    def restore(self, state: ChainState) -> int:
        """Go on with what another chain had learned, taxel by taxel, if its baselines saw the same values.

        Returns:
            The number of taxels that have their baselines again; 0 if there were other stages before them, or other
            units.

        Raises:
            ConfigurationError: that is no such state.
        """
        restored = 0
        for type_name, learning, group, name in self._learning if self.fits(state) else ():
            known = part_of(state.arrays, group)
            if known:
                row_of = {one: row for row, one in enumerate(known["uid"].tolist())}
                rows = np.array([row_of.get(one, -1) for one in self.uid(type_name).tolist()], np.intp)
                restored += learning.restore(part_of(known, name), rows) or 0
        return restored

    def fits(self, state: ChainState) -> bool:
        """Return whether its baselines see the same values as those of a state did."""
        return state.fingerprint == self._fingerprint

    def uid(self, type_name: str) -> npt.NDArray[np.uint64]:
        """Return (n,) uint64, the uids of the taxels of a type."""
        return self.structure.sensor_uid[self.structure.index(type_name)]

    @property
    def _fingerprint(self) -> str:
        before: list[object] = []
        for name, stages in self.stages.items():
            kinds = [stage.name for stage in stages]
            end = kinds.index(BaselineStage.name) if BaselineStage.name in kinds else 0
            of_driver = self._before.type(name)
            unit = stages[end - 1].taxels.type.unit if end else of_driver.unit
            before.append([name, unit, of_driver.scale, of_driver.offset, kinds[:end]])
        return repr(before)

    @property
    def baselines(self) -> dict[str, Baseline]:
        """By type, the first baseline of each."""
        return {name: stage.baseline for name, stage in self.baseline_stages.items()}

    def step(self, frame: DriverSnapshot, values: npt.NDArray[Any], status: Bytes) -> None:
        """Take the next sample of the driver through all stages.

        Fills (n_sensors,) float32 values with the output; and (n_sensors,) uint8 status with that of the sample,
        ``SUSPECT`` where a baseline was moved by force, and ``NEVER_SEEN`` where a stage has no result yet.
        """
        if self._warm:
            temperature_c = temperature_of(frame)
            for curve in self._warm:
                curve.temperature_c = temperature_c
        self.output[:], self.flags[:] = frame.physical_values(), frame.status
        _begin(self.at)
        time_ns = frame.acquired_ns
        for signal in self._signals.values():
            signal.time_ns = time_ns
        for stage, signals in self._steps:
            stage.step(*signals)
        _end(self.at)
        values[:], status[:] = self.output, self.flags

    def lose(self) -> None:
        """Let the output be that of a dead driver: nothing is known, and nothing touches."""
        self.output[:], self.flags[:] = 0, UNUSABLE

    def explain(self, uncertainty: Floats, why: Bytes) -> None:
        """Fill in (n_sensors,) how far the baselines of the newest sample can be trusted; others stay as they are."""
        for name, stage in self.baseline_stages.items():
            if stage.calm is not None:
                at = self._before.span(name)
                uncertainty[at], why[at] = stage.calm.uncertainty, stage.calm.why
