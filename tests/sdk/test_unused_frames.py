"""What the frames that a layout did not take say of it, in the words of a running driver."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from skinware.sensor_types import PRESSURE
from skinware.status import Unused
from skinware_drivers import EXTENDED_FLAG, Frame, Identifier, Layout, Module, NoOptions, Patch, Values, taxels
from skinware_drivers.can import CanAdapter
from skinware_drivers.counters import BusCounters, Samples
from skinware_drivers.fields import Byte
from skinware_drivers.running import patch_care
from skinware_drivers.running.patch_care import why_unused
from skinware_drivers.testing.waiting import wait_until
from tests.sdk.driving import Chatter, TroubledBus, driving_lines

SHORT = Frame("short", [Identifier(0x100), Byte(0, 1)], [7], Values(1, "u1", 6))
LONG = Frame("long", [Identifier(0x100), Byte(0, 2)], [4, 8], Values(1, "u1", 3))
OTHER = Frame("other", [Identifier(0x200)], [8], Values(1, "u1", 6))
FAR = Frame("far", [Identifier(EXTENDED_FLAG | 0x18DA0001)], [8], Values(1, "u1", 6))
EVERY = Frame("every", [], [8], Values(1, "u1", 6))


@dataclass
class Line:
    """A bus on which something was not taken."""

    medium: str = "can"
    samples: Samples = field(default_factory=Samples)
    counters: BusCounters = field(default_factory=BusCounters)

    def note(self, why: Unused, *frames: tuple[int, bytes]) -> Line:
        for identifier, payload in frames:
            self.samples.next_ns[why] = 0
            self.samples.note(why, identifier, payload)
        return self


@pytest.mark.parametrize(
    ("frames", "why", "sent", "words"),
    [
        (
            [SHORT, LONG, OTHER],
            Unused.BAD_LENGTH,
            (0x100, b"\1" + bytes(7)),
            "frames 'short' have length 7, but 8 bytes",
        ),
        (
            [SHORT, LONG, OTHER],
            Unused.BAD_LENGTH,
            (0x100, b"\2"),
            "frames 'long' have length 4 or 8, but 1 byte came (10",
        ),
        ([EVERY], Unused.BAD_LENGTH, (0x7, b""), "frames 'every' have length 8, but 0 bytes came (007 [0])"),
        (
            [SHORT],
            Unused.UNKNOWN,
            (EXTENDED_FLAG | 0x18DA00F1, b""),
            "heard 0x18DA00F1 (29 bits) where the layout has only",
        ),
        ([SHORT], Unused.UNKNOWN, (EXTENDED_FLAG | 0x100, b""), "heard 0x00000100 (29 bits) where the layout has only"),
        ([FAR], Unused.UNKNOWN, (0xF1, b""), "heard 0x0F1 (11 bits) where the layout has only identifiers of 29 bits"),
        ([FAR, SHORT], Unused.UNKNOWN, (0xF1, b""), ""),
        ([SHORT], Unused.UNKNOWN, (0xF1, b""), ""),
        ([SHORT], Unused.BAD_CONTENT, (0x100, b"\1"), ""),
    ],
)
def test_what_a_sample_says(frames: list[Frame], why: Unused, sent: tuple[int, bytes], words: str) -> None:
    reasons = why_unused(Layout(frames), Line().note(why, sent))  # type: ignore[arg-type]
    assert len(reasons) == bool(words)
    assert "".join(reasons).startswith(words)


def test_the_same_is_said_once() -> None:
    sent = [(EXTENDED_FLAG | 0x18DA0000 | n, b"") for n in range(3)]
    assert len(why_unused(Layout([SHORT]), Line().note(Unused.UNKNOWN, *sent))) == 1  # type: ignore[arg-type]
    anywhere = replace(SHORT, when=[Identifier(0x100, 0x7F0), Byte(0, 1)])
    line = Line().note(Unused.BAD_LENGTH, (0x101, b"\1"), (0x102, b"\1"), (0x103, b"\1\2"))
    reasons = why_unused(Layout([anywhere]), line)  # type: ignore[arg-type]
    assert [reason.partition("but ")[2].partition(" (")[0] for reason in reasons] == ["1 byte came", "2 bytes came"]


def test_checksums_that_are_wrong_are_counted() -> None:
    line = Line("serial")
    line.counters.framing.checksum_errors = 12
    assert why_unused(Layout([EVERY]), line) == [  # type: ignore[arg-type]
        "12 checksums were wrong: look at the kind of `checksum`, at its byte order and at what it `covers`"
    ]


class Fingers(CanAdapter[NoOptions]):
    """Some fingers, which send frames that are too long, or nothing."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint8
    layout = Layout([SHORT])
    patches = (Patch("finger 1", [Module(taxels(6))]),)


@pytest.mark.parametrize("count", [1, 20])
def test_silent_patches_are_told_of_in_one_line(
    count: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patch_care, "_DATA_TIMEOUT_S", 0.1)
    frames = [replace(SHORT, name=f"short {n}", when=[Identifier(0x100 + n)], patch=n) for n in range(count)]
    patches = [Patch(f"finger {n}", [Module(taxels(6, first_uid=16 * n))], key=n) for n in range(count)]
    driver = type("Silent", (Fingers,), {"layout": Layout(frames), "patches": patches})
    bus = TroubledBus("", hardware=Chatter((0x100, bytes(8))))
    with driving_lines([(driver(NoOptions()), bus)], "silent", wait=False):
        wait_until(lambda: any("no data" in text for text in caplog.messages))
    (told,) = [text for text in caplog.messages if "no data" in text]
    who = "finger 0 sends no data" if count == 1 else "20 patches send no data: finger 0, finger 1, finger 2, "
    assert told.startswith(f"bus0: {who}")
    assert told.endswith("; frames 'short 0' have length 7, but 8 bytes came (100 [8] 00 00 00 00 00 00 00 00)")
