"""Puts the emulated boards of a patch together, as its options say."""

from __future__ import annotations

import numpy as np

from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.roboskin.boards import Board, BoardParts
from skinware_drivers.virtual.roboskin.faults import BoardFaults
from skinware_drivers.virtual.roboskin.mtb3 import Mtb3
from skinware_drivers.virtual.roboskin.mtb4 import Mtb4
from skinware_drivers.virtual.roboskin.options import RoboskinOptions
from skinware_drivers.virtual.roboskin.pressed import PressedSkin
from skinware_drivers.virtual.roboskin.touch import Touch, WireSource, cycle_pattern
from skinware_drivers.virtual.wire import ForeignTraffic, Wire


def make_boards(
    options: RoboskinOptions,
    wire: Wire,
    log: EventLog,
    counts: dict[str, int],
    source: WireSource | None,
    skin: PressedSkin,
    now_ns: int,
) -> list[Board]:
    if source is None and options.pattern == "cycle":
        source = cycle_pattern
    phases = np.random.default_rng([options.seed, len(options.boards)]).uniform(0.02, 1, len(options.boards))
    boards: list[Board] = []
    for ordinal, address in enumerate(options.boards):
        parts = BoardParts(
            touch=Touch(options.seed, ordinal, skin),
            transmitter=wire.attach(),
            faults=BoardFaults(options, address, ordinal),
            log=log,
            counts=counts,
            phase=float(phases[ordinal]),
            source=source,
            short_tail=options.short_tail,
            tail_class=options.tail_class,
        )
        boards.append((Mtb3 if address in options.mtb3 else Mtb4)(address, parts, now_ns))
    return boards


def make_foreign_traffic(
    options: RoboskinOptions, wire: Wire, log: EventLog, counts: dict[str, int], now_ns: int
) -> list[ForeignTraffic]:
    """The other devices on the bus, where the options want any.

    Motor boards (class 1), strain gauges (class 3, which is also the old class of skin data), a skin board that
    nobody configured (class 4), inertial sensors (class 5), and 29-bit frames that end in the bits of a skin frame
    (classes: icub-firmware-shared:can/canProtocolLib/iCubCanProto_classes.h). No 11-bit frame comes from the address
    of an emulated board.
    """
    if not options.foreign_hz:
        return []
    identifiers = [
        message_class << 8 | address << 4 | low
        for message_class, low in ((1, 0), (1, 3), (3, 10), (3, 11), (4, 2), (5, 3))
        for address in range(1, 15)
        if address not in options.boards
    ] + [EXTENDED_FLAG | 0x1234_0000 | 0x400 | address << 4 | 3 for address in options.boards]
    random = np.random.default_rng([options.seed, len(options.boards), 2])
    return [ForeignTraffic(identifiers, options.foreign_hz, random, wire.attach(), log, counts, now_ns)]
