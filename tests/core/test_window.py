"""The last frames as one array."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin, Window
from skinware.errors import ConfigurationError, StructureError
from skinware.realtime import now_ns
from tests.cli.fake_skin import fake_structure
from tests.core.test_snapshot import publish


@pytest.mark.parametrize("count", [0, 1, 4, 5, 6, 13])
def test_the_last_frames_are_one_array_the_oldest_first(count: int) -> None:
    window = Window("temperature", 5)
    first_ns = now_ns()
    with DriverWriter("a", fake_structure(1, 2), slots=16, rate_hz=0.1) as writer, DriverReader("a") as reader:
        publish(writer, 0, first_ns)
        frames = reader.in_order(timeout_s=10)
        next(frames)
        for number in range(count):
            publish(writer, number, first_ns + number)
            window.add(next(frames))
    kept = list(range(count))[-5:]
    assert len(window) == len(kept)
    assert window.physical.dtype == np.float32
    assert window.physical.shape == ((len(kept), 4) if count else (0, 0))
    assert window.physical.tolist() == [[number * 0.5] * 4 for number in kept]
    assert window.time_ns.tolist() == [first_ns + number for number in kept]
    assert window.fresh.all()


def test_other_sensors_begin_anew() -> None:
    window = Window("pressure", 3)
    with DriverWriter("a", fake_structure(1, 1), rate_hz=0.1) as writer, Skin() as skin:
        publish(writer, 1)
        window.add(skin.read(timeout_s=10))
        window.add(skin.read())
        assert window.physical.shape == (2, 10)
        writer.restructure(fake_structure(1, 2))
        publish(writer, 2)
        while len(skin.read().raw("pressure")) == 10:
            pass
        window.add(skin.read())
        assert window.physical.tolist() == [[253.0] * 20]
        assert repr(window) == "<Window of pressure: 1 of 3 samples>"
        kept = window.physical
        window.add(skin.read())
        kept[:] = 0  # a copy
        assert window.physical.tolist() == [[253.0] * 20] * 2
        with pytest.raises(StructureError, match="no sensor type 'heat'"):
            Window("heat", 1).add(skin.read())
    with pytest.raises(ConfigurationError, match="a window of 0 samples"):
        Window("pressure", 0)
