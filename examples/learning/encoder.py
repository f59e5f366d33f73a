"""Teach an encoder touch without labels, and run it beside a driver.

Half of the taxels are hidden, and a small network learns to say from the others what they feel. On the way it makes a
code of 16 numbers, which says the touch shortly::

    python encoder.py train encoder.onnx grips/grips.mcap    # any recordings of one skin; needs torch, onnx, onnxscript
    python encoder.py serve encoder.onnx finger              # publishes the service "code"; needs onnxruntime
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.learning import ModelService, RecordedWindows, onnx_model

TYPE, WINDOW, CODE, HIDDEN = "pressure", 8, 16, 128
STEPS, BATCH = 2000, 256
HELD_OUT = 0.2
"""Share of the windows, the last ones, that it does not learn from."""


def train(target: Path, recordings: list[str]) -> None:
    """Train an encoder, say how well it knows hidden taxels of touch that it never saw, and write its ONNX file."""
    import torch

    torch.set_num_threads(1)  # for so small a network, more cost more
    torch.manual_seed(0)
    windows = RecordedWindows(*recordings, type_name=TYPE, window=WINDOW, step=2)
    values = torch.from_numpy(np.stack([np.where(each["fresh"], each["values"], 0) for each in windows]))
    split = round(len(values) * (1 - HELD_OUT))
    learnt, unseen = values[:split], values[split:]
    taxels = values.shape[2]

    class Encoder(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("mean", learnt.mean((0, 1)))
            self.register_buffer("spread", learnt.std((0, 1)) + 1e-3)
            self.layers = torch.nn.Sequential(
                torch.nn.Linear(WINDOW * taxels, HIDDEN),
                torch.nn.ReLU(),
                torch.nn.Linear(HIDDEN, CODE),
            )

        def scaled(self, touch: Any) -> Any:
            return (touch - self.mean) / self.spread

        def forward(self, touch: Any) -> Any:
            return self.layers(self.scaled(touch).flatten(1))

    encoder = Encoder()
    decoder = torch.nn.Sequential(
        torch.nn.Linear(CODE, HIDDEN), torch.nn.ReLU(), torch.nn.Linear(HIDDEN, WINDOW * taxels)
    )
    optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], 1e-3)

    def guessed(touch: Any) -> tuple[Any, Any, Any]:
        """Return hidden values, scaled, what the network says of them, and the mean of the visible ones."""
        hidden = (torch.rand(len(touch), 1, taxels) < 0.5).expand(touch.shape)
        wanted = encoder.scaled(touch)
        found = decoder(encoder(torch.where(hidden, encoder.mean, touch))).reshape(touch.shape)
        visible = (wanted * ~hidden).sum(2, keepdim=True) / (~hidden).sum(2, keepdim=True).clamp(min=1)
        return wanted[hidden], found[hidden], visible.expand(touch.shape)[hidden]

    for _ in range(STEPS):
        wanted, found, _ = guessed(learnt[torch.randint(len(learnt), (BATCH,))])
        loss = torch.nn.functional.mse_loss(found, wanted)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        wanted, found, visible = guessed(unseen)
    print(f"{len(learnt)} windows of {taxels} taxels learnt; of the hidden taxels in {len(unseen)} others it explains")
    of_all, of_mean = _explained(wanted, found), _explained(wanted, visible)
    print(f"{of_all:.0%} of the variance, the mean of the visible taxels {of_mean:.0%}")
    torch.onnx.export(
        encoder.eval(), (values[:1],), str(target), input_names=["values"], output_names=["code"], external_data=False
    )


def _explained(wanted: Any, found: Any) -> float:
    return float(1 - ((wanted - found) ** 2).mean() / wanted.var())


def serve(path: Path, driver: str) -> None:
    """Publish the code of the newest touch as a service, until Ctrl-C."""
    with ModelService(onnx_model(path), driver, type_name=TYPE, window=WINDOW, name="code") as service:
        service.run()


def own_encoder(network: Any, order: npt.NDArray[np.int64], lowest: float, highest: float) -> Any:
    """Return a model for ``ModelService`` of an encoder that was trained elsewhere, with torch.

    Args:
        network: takes (1, window, n) and (1, n, 3).
        order: (n,) which sensor is each input of the network.
        lowest, highest: range that the network knows as 0 to 1.
    """
    import torch

    def model(values: npt.NDArray[np.float32], positions: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        scaled = (values[:, order] - lowest) / (highest - lowest)
        with torch.no_grad():
            found = network(torch.from_numpy(scaled[None]), torch.from_numpy(positions[None, order]))
        code: npt.NDArray[np.float32] = found[0].numpy()
        return code

    return model


if __name__ == "__main__":
    if sys.argv[1] == "train":
        train(Path(sys.argv[2]), sys.argv[3:])
    else:
        serve(Path(sys.argv[2]), sys.argv[3])
