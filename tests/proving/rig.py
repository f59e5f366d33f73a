"""A hand with two matrices of taxels that a test presses and strokes, as a person is asked to, with planted faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware import DriverReader
from skinware.sensor_types import PRESSURE
from skinware_drivers.can import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.options import NoOptions
from skinware_drivers.proving.proof import Proof
from skinware_drivers.proving.walk import Manner, Step, walk
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid
from skinware_drivers.virtual.bus import VirtualCanBus

NAMES = ("index tip", "middle tip")
ROWS, COLUMNS = 4, 6
N = ROWS * COLUMNS
IDENTIFIERS = (0x301, 0x302)
STROKE_FRAMES = 60
"""Of a stroke, as the walk sees them: on a busy machine the finger waits for it."""


class Hand(CanAdapter[NoOptions]):
    """Two matrices, each in one CAN FD frame."""

    types = (PRESSURE.measured(unit="counts", maximum=255),)
    dtype = np.uint8
    period_s = 0.01
    patches = (
        Patch(
            "hand",
            [
                Module(taxels(N, first_uid=100 * key), key=key, kind=f"{ROWS}x{COLUMNS}", name=name)
                for key, name in enumerate(NAMES)
            ],
        ),
    )
    layout = Layout(
        [
            Frame(name, [Identifier(number)], length=(N,), values=Values(0, "u1", N), module=key)
            for key, (name, number) in enumerate(zip(NAMES, IDENTIFIERS, strict=True))
        ]
    )


class TaringHand(Hand):
    """A hand that can tare.

    Attributes:
        on_tare: does it.
    """

    on_tare: Callable[[], None]

    @operation()
    async def tare(self, link: Link, patches: object) -> None:
        """Take the present values as zero."""
        self.on_tare()


class EmulatedHand(Emulator[EmulatorOptions]):
    """It feels what ``touch`` says, through its wiring.

    Attributes:
        offset: what it shows of nothing.
        touch: module and, of it, what its taxels feel in their own order; None: nothing.
        wiring: (2 * N,) the taxel that each place of the protocol shows.
        dead: places that always say 7.
    """

    identifiers = IDENTIFIERS
    full_scale = 255
    swing = 100

    def __init__(self, wiring: npt.NDArray[np.int64], dead: Sequence[int] = ()) -> None:
        super().__init__(msgspec.convert({"streaming": True}, EmulatorOptions))
        self.period_s = 0.01
        self.wiring, self.dead = wiring, list(dead)
        self.person: PressingPerson | None = None
        self.offset = 10

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(2 * N, COLUMNS)

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        noise = (np.arange(2 * N) * 7 + device.cycle) % 3
        felt = self.offset + noise + (0 if self.person is None else np.rint(self.person.touch()).astype(np.int64))
        shown = felt[self.wiring]
        shown[self.dead] = 7
        return [int(value) for value in np.minimum(shown, 255)]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [(number, bytes(values[key * N : (key + 1) * N])) for key, number in enumerate(IDENTIFIERS)]


@dataclass
class PressingPerson:
    """Do each step at once, without those to skip or ignore.

    Attributes:
        skipped: modules that it leaves out.
        ignored: kinds of steps that it does not hear.
        asked: all steps.
    """

    skipped: Sequence[str] = ()
    ignored: Sequence[str] = ()
    asked: list[Step] = field(default_factory=list)
    _now: Step | None = None
    _seen: int = 0

    def ask(self, step: Step) -> None:
        self.asked.append(step)
        self._now, self._seen = step, 0

    def skips(self) -> bool:
        self._seen += 1
        return self._now is not None and self._now.module in self.skipped

    def touch(self) -> npt.NDArray[np.float64]:
        """(2 * N,) what the taxels feel of it now."""
        felt = np.zeros((2, ROWS, COLUMNS))
        step = self._now
        if step is None or step.wanted in ("rest", "let go", *self.ignored):
            return felt.ravel()
        rows, columns = np.mgrid[:ROWS, :COLUMNS]
        if step.wanted == "press":
            spot = np.exp(-((rows - 1.5) ** 2 + (columns - 2.5) ** 2) / 4)
        else:
            size, line = (ROWS, rows) if step.wanted == "stroke down" else (COLUMNS, columns)
            part = self._seen / STROKE_FRAMES
            spot = np.exp(-((line - (part * (size + 3) - 2)) ** 2)) * (part < 1)
        felt[NAMES.index(step.module.removeprefix("hand, "))] = 150 * spot
        return felt.ravel()


def straight() -> npt.NDArray[np.int64]:
    """No fault."""
    return np.arange(2 * N)


@contextmanager
def hand(
    person: PressingPerson,
    wiring: npt.NDArray[np.int64],
    dead: Sequence[int] = (),
    on_tare: Callable[[EmulatedHand], None] | None = None,
) -> Iterator[DriverReader]:
    """A reader of a driver on an emulated hand that a person has, and that can be tared if it is said how."""
    devices = EmulatedHand(wiring, dead)
    devices.person = person
    driver = Hand(NoOptions()) if on_tare is None else TaringHand(NoOptions())
    if isinstance(driver, TaringHand) and on_tare is not None:
        driver.on_tare = partial(on_tare, devices)
    bus = VirtualCanBus("", hardware=devices, payload_size=64)
    with driving_lines([(driver, bus)], "hand"), DriverReader("hand", timeout_s=30) as reader:
        yield reader


def proven(
    person: PressingPerson,
    wiring: npt.NDArray[np.int64],
    dead: Sequence[int] = (),
    on_tare: Callable[[EmulatedHand], None] | None = None,
    **manner: Any,
) -> Proof:
    """What comes of a walk."""
    proof = Proof("hand", "hand", {})
    with hand(person, wiring, dead, on_tare) as reader:
        walk(reader, person, Manner(**{"rest_s": 1.0, "patience_s": 20.0} | manner), proof)
    return proof


def failed(proof: Proof) -> Mapping[tuple[str, str], str]:
    """What failed, but for rates and losses: the machine may be busy."""
    wrong = [check for check in proof.checks if check.verdict == "failed" and check.what not in ("rate", "losses")]
    return {(check.what, check.where): check.seen for check in wrong}
