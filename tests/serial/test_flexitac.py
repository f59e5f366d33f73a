"""FlexiTac and 3D-ViTac: bytes by hand (after the makers' firmware, not captured), sizes that are heard, refusals."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, Status
from skinware.errors import ConfigurationError
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.flexitac import FlexiTacDriver, FlexiTacOptions
from skinware_drivers.serial.framings import Recurring, TextMatrix
from skinware_drivers.serial.packets import Packet
from skinware_drivers.testing.driving import emulated_on_a_pty, emulated_skin
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.devices.flexitac import EmulatedFlexiTac, EmulatedFlexiTacOptions
from tests.sdk.driving import driving_lines, read_until, restarted_on_demand
from tests.serial.lines import line
from tests.serial.spoken import Spoken
from tests.serial.streams import cut, outcome

MARKER = b"\xaa\x55"
TWO_BY_THREE = b"12 0 255 \r\n7 8 9 \r\n\r\n"


def found(framing: Any, stream: bytes) -> list[bytes]:
    return [frame.body for frame in framing.framer().feed(stream)]


# -- the emulator, byte by byte


@pytest.mark.parametrize(("rows", "columns", "size"), [(16, 16, 258), (12, 32, 386), (16, 32, 514)])
def test_emulated_binary_firmware(rows: int, columns: int, size: int) -> None:
    options = EmulatedFlexiTacOptions(rows=rows, columns=columns, broken_rows=(1,), broken_columns=(2,))
    count = rows * columns
    pad = Spoken(EmulatedFlexiTac(options, source=lambda _n, _c: [1 + at % 250 for at in range(count)]))
    frames = pad.answers(b"", 45)
    assert len(frames) in (4, 5)
    assert frames[0] == frames[1]
    assert len(frames[0]) == size
    assert frames[0][:6] == bytes.fromhex("AA 55 01 02 00 04")
    assert frames[0][2 + columns : 2 + 2 * columns] == bytes(columns)
    assert frames[0][-1] == 1 + (count - 1) % 250


def test_emulated_text_firmware() -> None:
    options = EmulatedFlexiTacOptions(rows=2, columns=3, firmware="text")
    pad = Spoken(EmulatedFlexiTac(options, source=lambda _n, _c: [12, 0, 255, 7, 8, 9]))
    assert pad.answers(b"", 15)[0] == TWO_BY_THREE


# -- framing


def test_a_frame_counts_if_the_next_begins_right_behind_it() -> None:
    """Markers among the cells change nothing; a frame that lost cells, or was joined halfway, is not shown."""
    framing = Packet(sync=MARKER, length=18, confirmed="each")
    cells = [bytes([n]) * 5 + MARKER + bytes([n]) * 9 for n in range(9)]
    frames = [MARKER + body for body in cells]
    assert found(framing, b"".join(frames)) == cells[:-1]
    assert found(framing, frames[0][9:] + b"".join(frames[1:])) == cells[1:-1]
    cut_one = b"".join(frames[:2]) + frames[2][:10] + b"".join(frames[3:])
    assert found(framing, cut_one + frames[0]) == [*cells[:2], *cells[3:]]


def test_the_length_of_frames_is_heard() -> None:
    framing = Recurring(MARKER, maximum_body=1024, minimum_body=16)
    rng = np.random.default_rng(4)
    for count in (256, 384, 512, 1024):
        cells = [rng.integers(0, 256, count, np.uint8).tobytes() for _ in range(9)]
        cells = [body[:40] + MARKER + body[42:] for body in cells]  # a marker that stays at one place, too
        stream = b"".join(MARKER + body for body in cells)
        assert found(framing, stream)[:5] == cells[:5]
        assert {len(body) for body in found(framing, stream[100:])} == {count}
        places = rng.integers(0, len(stream), 40).tolist()
        assert outcome(framing, cut(stream, places)) == outcome(framing, [stream])
    assert found(framing, rng.integers(0, 256, 20_000, np.uint8).tobytes()) == []


def test_text_is_a_matrix_or_nothing() -> None:
    framing = TextMatrix(rows=16, columns=16)
    good = bytes([2, 3, 12, 0, 255, 7, 8, 9])
    first = b"6 7 \r\n\r\n"  # may be the end of a matrix
    assert found(framing, first + TWO_BY_THREE * 2) == [good] * 2
    assert found(framing, first + TWO_BY_THREE.replace(b"\r", b"")) == [good]
    for wrong in (
        b"12 0 256 \r\n7 8 9 \r\n\r\n",
        b"12 0 \r\n7 8 9 \r\n\r\n",
        b"12 -1 5 \r\n7 8 9 \r\n\r\n",
        b"12 0x1 5 \r\n7 8 9 \r\n\r\n",
        b"12 1_0 5 \r\n7 8 9 \r\n\r\n",
        b"12 \xb2 5 \r\n7 8 9 \r\n\r\n",
        b"1 \r\n" * 17 + b"\r\n",
        b"1 " * 17 + b"\r\n\r\n",
        b"9" * 5000 + b"\r\n\r\n",
    ):
        assert found(framing, first + wrong + TWO_BY_THREE) == [good], wrong
    assert framing.encode(0, good) == b"12 0 255\n7 8 9\n\n"
    with pytest.raises(ValueError, match="2 x 3 and has 5"):
        framing.encode(0, good[:-1])


def test_text_in_pieces_is_the_same() -> None:
    rng = np.random.default_rng(5)
    framing = TextMatrix(rows=3, columns=4)
    for _ in range(300):
        parts = [TWO_BY_THREE, b"\r\n", b"\n", b"\r", b"1 2 3", b"9" * 30, b"12 255 0 1 \r\n" * 3 + b"\r\n", b"\0"]
        stream = b"".join(parts[n] for n in rng.integers(0, len(parts), 20))
        places = rng.integers(0, len(stream), 15).tolist()
        assert outcome(framing, cut(stream, places)) == outcome(framing, [stream]), (stream, places)


# -- the driver, on pseudo terminals


def shown(stream: bytes, **options: Any) -> DriverSnapshot:
    """A frame of what a driver shows of a stream that comes again and again."""
    driver = FlexiTacDriver(FlexiTacOptions(**options))
    with line() as port:
        bus = SerialBus(port.path, payload_size=driver.payload_size)
        with driving_lines([(driver, bus)], "pad", wait=False) as running:

            def is_shown() -> bool:
                port.write(stream)
                return running.runner is not None and running.runner.builder.writer is not None

            wait_until(is_shown)
            with DriverReader("pad", timeout_s=30) as reader:

                def is_seen(frame: DriverSnapshot) -> bool:
                    port.write(stream)
                    return not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any()

                return read_until(reader, is_seen)


def test_values_saturation_and_cells_of_broken_lines() -> None:
    cells = bytearray(range(1, 255)) + bytearray(130)
    cells[3], cells[254:] = 255, bytes([20]) * 130
    cells[32:64] = bytes(32)
    frame = shown(5 * (MARKER + bytes(cells)))
    assert frame.values.tolist() == list(cells)
    assert np.flatnonzero(frame.status & Status.OUT_OF_RANGE).tolist() == [3]
    assert np.flatnonzero(frame.status & Status.SUSPECT).tolist() == list(range(32, 64))
    structure = frame.structure
    assert structure.module_kind.tolist() == [b"12x32"]
    assert structure.geometry is not None
    place = structure.geometry.position_m
    assert place[1, 0] - place[0, 0] == pytest.approx(0.002)
    assert place[0, 1] - place[32, 1] == pytest.approx(0.002)


def test_sizes_that_are_told_and_zeros_that_are_good() -> None:
    frame = shown(5 * (MARKER + bytes(6)), size="2x3", zero="good", pitch_mm=5)
    assert frame.structure.module_kind.tolist() == [b"2x3"]
    assert not frame.status.any()
    frame = shown(3 * TWO_BY_THREE, firmware="text")
    assert frame.structure.module_kind.tolist() == [b"2x3"]
    assert frame.values.tolist() == [12, 0, 255, 7, 8, 9]
    assert frame.status.tolist() == [0, Status.SUSPECT, Status.OUT_OF_RANGE, 0, 0, 0]


@pytest.mark.parametrize(
    ("options", "emulated", "message"),
    [
        ({"size": "12x32"}, {"rows": 16}, r"512 cells are heard, which is 16x32; .*12x32 has not: say size=16x32"),
        ({"size": "16x32"}, {"rows": 16, "columns": 16}, r"256 cells are heard, which is 16x16; .* say size=16x16"),
        ({"size": "12x32"}, {"rows": 8, "columns": 10}, r"80 cells are heard; .* say size=ROWSxCOLUMNS of as many"),
        ({}, {"rows": 8, "columns": 10}, r"80 cells are heard, which is no published board: say size=ROWSxCOLUMNS"),
        (
            {"firmware": "text", "size": "16x16"},
            {"firmware": "text", "rows": 12, "columns": 32},
            r"384 cells are heard, which is 12x32; .* say size=12x32",
        ),
        ({}, {"firmware": "text"}, r"no matrix was heard within 3 s; .*firmware=text"),
    ],
)
def test_a_wrong_size_is_told_with_the_one_that_is_heard(
    options: dict[str, Any], emulated: dict[str, Any], message: str, caplog: pytest.LogCaptureFixture
) -> None:
    driver = FlexiTacDriver(FlexiTacOptions(**options))
    with caplog.at_level(logging.WARNING), emulated_on_a_pty(EmulatedFlexiTac, **emulated) as path:
        bus = SerialBus(path, payload_size=driver.payload_size)
        with driving_lines([(driver, bus)], "pad", wait=False):
            wait_until(lambda: bool(caplog.messages))
    assert re.search(message, caplog.messages[0]), caplog.messages


@pytest.mark.parametrize("firmware", ["binary", "text"])
def test_another_pad_is_plugged_in(firmware: str, tmp_path: Path) -> None:
    link = tmp_path / "port"
    driver = FlexiTacDriver(FlexiTacOptions(firmware=firmware))  # type: ignore[arg-type]
    bus = SerialBus(str(link), payload_size=driver.payload_size)
    with driving_lines([(driver, bus)], "pad", wait=False, wait_for_buses=True) as running:
        for rows, columns in ((12, 32), (16, 32)):
            options = {"rows": rows, "columns": columns, "firmware": firmware, "period_ms": 20}
            with emulated_on_a_pty(EmulatedFlexiTac, **options) as path:
                link.symlink_to(path)

                def is_live(count: int = rows * columns) -> bool:
                    generation = running.runner and running.runner.builder.generation
                    if not generation or generation.tables.structure.n_sensors != count:
                        return False
                    return bool(running.status()["patches"][0]["state"] == "live")

                wait_until(is_live)
                link.unlink()


def test_it_comes_back_after_a_reset() -> None:
    """Its port was opened by somebody: two seconds of silence, then data; nothing torn is shown."""
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "repeat": 0.02}
    with emulated_skin(FlexiTacDriver, EmulatedFlexiTac, pattern="cycle", boot_s=0.3, **faults) as skin:
        for _ in range(20):
            frame = read_until(skin.reader, lambda f: not (f.status & Status.STALE).any())
            assert len(set(frame.values.tolist())) == 1


@pytest.mark.parametrize("size", ["12", "0x32", "65x2", "12x32x2", "axb"])
def test_sizes_that_cannot_be(size: str) -> None:
    with pytest.raises(ConfigurationError, match="size"):
        FlexiTacOptions(size=size)


def test_cells_that_look_like_the_marker() -> None:
    """All the time, also over lost bytes and restarts: no matrix is shown shifted."""

    class Alike(EmulatedFlexiTac):
        def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
            cells = [*values]
            cells[100:102] = MARKER
            return super().messages(device, cells)

    devices = restarted_on_demand(Alike)
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "repeat": 0.02}
    with emulated_skin(FlexiTacDriver, devices, pattern="cycle", boot_s=0.3, **faults) as skin:
        for number in range(60):
            devices.restart_now = number % 20 == 19
            frame = read_until(skin.reader, lambda f: not (f.status & (Status.STALE | Status.NEVER_SEEN)).any())
            values = frame.values.tolist()
            assert values[100:102] == [*MARKER]
            assert len(set(values[:100] + values[102:])) == 1
