"""Run a model over the touch of a driver, and publish its output as a service of its own."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError, MissingExtra, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.service import Column, ServiceWriter
from skinware.snapshot import Window

log = logging.getLogger("skinware.learning")

_TURN_S = 0.2
Output = npt.NDArray[Any] | Mapping[str, npt.NDArray[Any]]
Model = Callable[[npt.NDArray[np.float32], npt.NDArray[np.float32]], Output]
"""Takes (window, n) float32 values, the oldest first and 0 where not fresh, and (n, 3) positions in m, NaN where they
are not known; returns an array, or arrays by name, of the same shapes each time."""


class ModelService:
    """Calls a model for each newest window of a driver's touch, and publishes what it returns.

    Columns of a sample: those of the model (``output`` for a single array), ``latency_ms`` (1,) from the newest data to
    the output, ``failed`` (1,) uint8 and ``failures`` (1,) uint64. If the model raises, returns other shapes or numbers
    that are not finite, the sample has the output before and ``failed`` 1; the service goes on. A model that is slower
    than the driver misses windows; those that it gets have each sample that the ring still had.

    Args:
        model: see :data:`Model`.
        driver: name of the driver.
        type_name: which sensors.
        window: samples that the model gets.
        name: of the service.
        namespace: of both; default: the one of ``SKINWARE_NAMESPACE``.
        timeout_s: longest wait for the driver.

    Raises:
        ServiceNotFound, ServiceTimeout: the driver does not run, or published nothing in time.
        StructureError: it has no such sensors.
        ConfigurationError: the model fails with zeros, or returns what no column can hold.
        NameInUse: another program publishes a service of this name.
    """

    def __init__(
        self,
        model: Model,
        driver: str,
        *,
        type_name: str = "pressure",
        window: int = 1,
        name: str = "model",
        namespace: Namespace | str | None = None,
        timeout_s: float = 5.0,
    ) -> None:
        self._model, self._type_name = model, type_name
        self._reader = DriverReader(driver, namespace=namespace, timeout_s=timeout_s)
        try:
            self._position = self._places()
            self._window = Window(type_name, window)
            try:
                self._last = _arrays(model(np.zeros((window, len(self._position)), np.float32), self._position))
            except Exception as error:
                raise ConfigurationError(f"the model fails with zeros: {error}") from error
            columns = {key: Column(each.dtype, each.shape) for key, each in self._last.items()}
            columns |= {
                "latency_ms": Column(
                    np.dtype("<f4"), (1,), unit="ms", description="from the newest data to the output"
                ),
                "failed": Column(np.dtype("u1"), (1,), description="1: the model failed, and the output is an old one"),
                "failures": Column(np.dtype("<u8"), (1,), description="so far"),
            }
            self._writer = ServiceWriter(name, columns, namespace=namespace, description=f"a model over {driver}")
        except BaseException:
            self._reader.close()
            raise
        self.failures = 0

    def run(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Call the model for each newest sample, until ``is_stopped``; wait for a driver that died.

        Raises:
            StructureChanged: the driver came back with other sensors: make a new service.
        """
        while not is_stopped():
            try:
                sample = self._reader.read_next(timeout_s=_TURN_S)
            except ServiceTimeout:
                continue
            if self._reader.waiting:
                self._window.add(sample)
            else:
                self.take(sample)

    def take(self, sample: DriverSnapshot) -> None:
        """Add a sample of the driver; call the model and publish as soon as the window is full."""
        self._window.add(sample)
        if len(self._window) < self._window.length:
            return
        values = np.where(self._window.fresh, self._window.physical, 0).astype(np.float32)
        failed = False
        try:
            found = _arrays(self._model(values, self._position))
            if _forms(found) != _forms(self._last):
                raise ConfigurationError(f"the model returned {_forms(found)}, and {_forms(self._last)} at first")
            if not all(np.isfinite(each).all() for each in found.values() if each.dtype.kind == "f"):
                raise ConfigurationError("the model returned numbers that are not finite")
            self._last = found
        except Exception:
            failed = True
            if not self.failures:
                log.exception("the model failed; its service goes on, and counts further failures")
            self.failures += 1
        columns = self._writer.begin()
        for name, array in self._last.items():
            columns[name][...] = array
        columns["latency_ms"][:] = (time.monotonic_ns() - sample.acquired_ns) / 1e6
        columns["failed"][:], columns["failures"][:] = failed, self.failures
        self._writer.commit(sample.acquired_ns)

    def close(self) -> None:
        """End the service. Idempotent."""
        self._reader.close()
        self._writer.close()

    def _places(self) -> npt.NDArray[np.float32]:
        structure = self._reader.structure
        index = structure.index(self._type_name)
        if structure.geometry is None:
            return np.full((len(index), 3), np.nan, np.float32)
        return structure.geometry.position_m[index].astype(np.float32)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def onnx_model(path: str | Path) -> Model:
    """Return a model of an ONNX file, whose first input takes (1, window, n) float32, and a second one (1, n, 3).

    Its outputs are the columns, without the leading 1, by their names in the file.

    Raises:
        MissingExtra: onnxruntime is not installed.
        ConfigurationError: the file is no ONNX model.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it reads this when it is imported
    try:
        import onnxruntime
    except ImportError:
        raise MissingExtra.of("ONNX models", "skinware[onnx]") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # more of them would wait busily, beside drivers
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ConfigurationError(f"{path}: no ONNX model ({error})") from error
    inputs = [each.name for each in session.get_inputs()]
    outputs = [each.name for each in session.get_outputs()]

    def run(values: npt.NDArray[np.float32], position: npt.NDArray[np.float32]) -> Output:
        given = dict(zip(inputs, (values[np.newaxis], np.nan_to_num(position)[np.newaxis]), strict=False))
        return {name: found[0] for name, found in zip(outputs, session.run(outputs, given), strict=True)}

    return run


def _arrays(output: Output) -> dict[str, npt.NDArray[Any]]:
    named = output if isinstance(output, Mapping) else {"output": output}
    return {name: np.asarray(each) for name, each in named.items()}


def _forms(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, str]:
    return {name: f"{each.dtype.name}{each.shape}" for name, each in arrays.items()}
