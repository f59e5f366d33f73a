"""A model as a service gets the newest window, and its failures stop nothing else."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from skinware import DriverReader, DriverWriter, ServiceReader, Status
from skinware.errors import ConfigurationError, StructureError
from skinware.learning.model_service import ModelService, onnx_model
from skinware.realtime import now_ns
from skinware_drivers.testing.waiting import wait_until
from tests.learning.test_live import hand, publish
from tests.tactile.skins import placed

Values = npt.NDArray[np.float32]


def sums(values: Values, position: Values) -> dict[str, npt.NDArray[np.float32]]:
    """The sum of each sample; it does not like more than 100."""
    if values.max() > 100:
        raise ValueError("too much")
    return {"sum": values.sum(axis=1), "places": np.nan_to_num(position[:, 0])}


def test_its_output_is_that_of_the_newest_window() -> None:
    geometry = placed(np.column_stack([np.arange(15) * 0.01, np.zeros(15), np.zeros(15)]))
    with DriverWriter("hand", hand().placed(geometry), rate_hz=0.1) as writer:  # samples are fresh for 30 s
        publish(writer, 1, now_ns())
        with (
            ModelService(sums, "hand", window=2) as service,
            DriverReader("hand") as hands,
            ServiceReader("model") as reader,
        ):
            service.take(hands.read())
            assert reader.latest() is None  # the window is not full
            begin_ns = now_ns()
            publish(writer, 2, begin_ns)
            service.take(hands.read())
            sample = reader.read()
            assert sample.column("sum").tolist() == [15.0, 30.0]
            assert np.allclose(sample.column("places"), np.arange(15) * 0.01)
            assert sample.acquired_ns == begin_ns
            assert 0 <= sample.column("latency_ms")[0] <= (now_ns() - begin_ns) / 1e6
            assert (sample.column("failed")[0], sample.column("failures")[0]) == (0, 0)
            publish(writer, 3, now_ns(), Status.STALE)
            service.take(hands.read())
            assert reader.read().column("sum").tolist() == [30.0, 0.0]


def test_its_failures_are_counted_and_the_output_before_stays(caplog: pytest.LogCaptureFixture) -> None:
    outputs = iter([np.zeros(2), np.ones(2), np.array([np.nan, 0.0]), np.zeros(3), np.full(2, 5.0)])
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        publish(writer, 1, now_ns())
        model = ModelService(lambda values, position: next(outputs), "hand", name="odd")
        with model as service, DriverReader("hand") as hands, ServiceReader("odd") as reader:
            seen = []
            for _ in range(5):  # the last one raises: there are no more outputs
                publish(writer, 1, now_ns())
                service.take(hands.read())
                sample = reader.read()
                seen.append((sample.column("output").tolist(), int(sample.column("failed")[0])))
            assert seen == [([1, 1], 0), ([1, 1], 1), ([1, 1], 1), ([5, 5], 0), ([5, 5], 1)]
            assert sample.column("failures")[0] == 3
    assert caplog.text.count("the model failed; its service goes on") == 1
    caplog.clear()


def test_a_slow_model_misses_windows_but_no_sample_in_them() -> None:
    windows: list[list[float]] = []

    def note(values: Values, position: Values) -> npt.NDArray[np.float32]:
        windows.append(values[:, 0].tolist())
        return np.zeros_like(position)

    with DriverWriter("hand", hand(), rate_hz=50) as writer:

        def publish_all(*values: int) -> None:
            for value in values:
                publish(writer, value, now_ns())

        publish_all(1)
        with ModelService(note, "hand", window=2) as service:
            turns = iter([(), (2,), (3, 4, 5), (), (), None])

            def is_stopped() -> bool:
                values = next(turns)
                publish_all(*(values or ()))
                return values is None

            service.run(is_stopped)
    assert windows == [[0, 0], [1, 2], [4, 5]]


def test_it_runs_beside_a_driver_that_comes_back() -> None:
    stop = threading.Event()
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        publish(writer, 1, now_ns())
        service = ModelService(sums, "hand")
        thread = threading.Thread(target=service.run, args=(stop.is_set,))
        thread.start()
        with ServiceReader("model", timeout_s=60) as reader:
            assert reader.read(timeout_s=60).column("sum").tolist() == [15.0]
            writer.close()
            with DriverWriter("hand", hand(), rate_hz=50) as again:
                publish(again, 3, now_ns())
                wait_until(lambda: reader.read().column("sum").tolist() == [45.0])
        stop.set()
        thread.join()
        service.close()


def test_a_model_that_cannot_run_is_refused_at_once(tmp_path: Path) -> None:
    with DriverWriter("hand", hand(), rate_hz=50) as writer:
        publish(writer, 1, now_ns())
        with pytest.raises(ConfigurationError, match=r"the model fails with zeros: .*division"):
            ModelService(lambda values, position: np.array(1 // 0), "hand")
        with pytest.raises(StructureError, match="force_z"):
            ModelService(sums, "hand", type_name="force_z")
    with pytest.raises(ConfigurationError, match="no ONNX model"):
        onnx_model(tmp_path / "model.onnx")


def write_onnx(path: Path, window: int, taxels: int, *, with_positions: bool) -> None:
    """The mean over the window, and where the touch is: the mean of the places, weighted by the newest values."""
    inputs = [helper.make_tensor_value_info("values", TensorProto.FLOAT, [1, window, taxels])]
    outputs = [helper.make_tensor_value_info("mean", TensorProto.FLOAT, [1, taxels])]
    nodes = [helper.make_node("ReduceMean", ["values"], ["mean"], axes=[1], keepdims=0)]
    newest: list[TensorProto] = []
    if with_positions:
        newest = [numpy_helper.from_array(np.array(window - 1), "newest")]
        inputs.append(helper.make_tensor_value_info("positions", TensorProto.FLOAT, [1, taxels, 3]))
        outputs.append(helper.make_tensor_value_info("moment", TensorProto.FLOAT, [1, 3]))
        nodes += [
            helper.make_node("Gather", ["values", "newest"], ["last"], axis=1),
            helper.make_node("MatMul", ["last", "positions"], ["moments"]),
            helper.make_node("ReduceMean", ["moments"], ["moment"], axes=[1], keepdims=0),
        ]
    graph = helper.make_graph(nodes, "touch", inputs, outputs, newest)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def test_an_onnx_file_runs_over_history_and_places(tmp_path: Path) -> None:
    for name, with_positions in (("plain", False), ("placed", True)):
        write_onnx(tmp_path / f"{name}.onnx", 2, 15, with_positions=with_positions)
    geometry = placed(np.column_stack([np.arange(15) * 0.01, np.zeros(15), np.zeros(15)]))
    with DriverWriter("hand", hand().placed(geometry), rate_hz=50) as writer:
        publish(writer, 1, now_ns())
        for name in ("plain", "placed"):
            model = onnx_model(tmp_path / f"{name}.onnx")
            with (
                ModelService(model, "hand", window=2, name=name) as service,
                DriverReader("hand") as hands,
                ServiceReader(name) as reader,
            ):
                for value in (1, 4):
                    publish(writer, value, now_ns())
                    service.take(hands.read())
                sample = reader.read()
                assert sample.column("mean").tolist() == [2.5] * 15
                if name == "placed":
                    assert sample.column("moment") == pytest.approx([4 * 1.05, 0, 0])
        with pytest.raises(ConfigurationError, match=r"the model fails with zeros: .*values"):
            ModelService(onnx_model(tmp_path / "plain.onnx"), "hand", window=3)
