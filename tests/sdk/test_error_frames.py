"""What CAN error frames mean, by the classes of linux/can/error.h, however they fall into batches."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.status import BusReason
from skinware_drivers.bus import ERROR_FLAG
from skinware_drivers.can.controller import (
    TROUBLE_LASTS_S,
    Controller,
    ControllerHealth,
    is_missing,
    parse_answer,
    read_controller,
)

# class, bytes 0 to 7, and what is wrong then; from linux/can/error.h and the drivers sja1000, mcp251xfd, dev/dev.c
FRAMES = {
    "warning, receiving": (0x004, "0004000000000000", BusReason.ERROR_WARNING),
    "warning, sending": (0x004, "0008000000000000", BusReason.ERROR_WARNING),
    "passive, receiving": (0x004, "0010000000000000", BusReason.ERROR_PASSIVE),
    "passive, sending, with counters": (0x204, "0020000000008800", BusReason.ERROR_PASSIVE),
    "passive and warning": (0x004, "0024000000000000", BusReason.ERROR_PASSIVE),
    "bus-off": (0x040, "0000000000000000", BusReason.BUS_OFF),
    "bus-off with the way to it": (0x044, "0020000000000000", BusReason.BUS_OFF),
    "active again": (0x004, "0040000000000000", BusReason.NONE),
    "restarted": (0x100, "0000000000000000", BusReason.NONE),
    "overflow in receiving": (0x004, "0001000000000000", BusReason.OVERFLOW),
    "overflow in sending is not ours": (0x004, "0002000000000000", BusReason.NONE),
    "no acknowledgement": (0x020, "0000000000000000", BusReason.NO_ACKNOWLEDGEMENT),
    "no acknowledgement, as the SJA1000 says it": (0x088, "0000001900000000", BusReason.NO_ACKNOWLEDGEMENT),
    "stuff error": (0x088, "0000040A00000000", BusReason.BUS_ERRORS),
    "bus error": (0x080, "0000000000000000", BusReason.BUS_ERRORS),
    "no CANH wire": (0x010, "0000000004000000", BusReason.BUS_ERRORS),
    "transmission timeout": (0x001, "0000000000000000", BusReason.NONE),
    "arbitration lost": (0x002, "0C00000000000000", BusReason.NONE),
    "detail without its class": (0x001, "0010000000000000", BusReason.NONE),
}


def take(health: ControllerHealth, *frames: tuple[int, str], time_ns: int = 0) -> None:
    identifier = np.array([ERROR_FLAG | kind for kind, _ in frames], np.uint32)
    payload = np.array([list(bytes.fromhex(text)) for _, text in frames], np.uint8).reshape(len(frames), 8)
    health.take(identifier, payload, time_ns)


@pytest.mark.parametrize("what", FRAMES)
def test_every_class(what: str) -> None:
    kind, payload, reason = FRAMES[what]
    health = ControllerHealth()
    take(health, (kind, payload))
    assert health.reason(1) == reason


def test_a_state_lasts_until_another_is_told_and_a_trouble_for_a_while() -> None:
    health = ControllerHealth()
    later_ns = round(TROUBLE_LASTS_S * 1e9)
    take(health, (0x4, "0001000000000000"))
    assert health.reason(later_ns - 1) == BusReason.OVERFLOW
    assert health.reason(later_ns) == BusReason.NONE
    take(health, (0x4, "0010000000000000"))
    assert health.reason(1000 * later_ns) == BusReason.ERROR_PASSIVE
    take(health, (0x4, "0008000000000000"), (0x20, "0000000000000000"))
    assert health.reason(0) == BusReason.ERROR_WARNING  # of two, the controller's state is told
    take(health, (0x4, "0040000000000000"))
    assert health.reason(0) == BusReason.OVERFLOW  # the worse of two troubles


def test_bus_off_ends_with_a_restart_or_with_data() -> None:
    health = ControllerHealth()
    off, restarted = (0x40, "00" * 8), (0x100, "00" * 8)
    take(health, off, off)
    assert (health.reason(0), health.bus_offs) == (BusReason.BUS_OFF, 1)
    take(health, off)
    assert health.bus_offs == 1
    take(health, restarted)
    assert health.reason(0) == BusReason.NONE
    take(health, off, restarted, off)
    assert (health.reason(0), health.bus_offs) == (BusReason.BUS_OFF, 3)
    health.heard_data()
    assert health.reason(0) == BusReason.NONE


def test_data_is_no_proof_against_other_states() -> None:
    health = ControllerHealth()
    take(health, (0x4, "0010000000000000"))
    health.heard_data()
    assert health.reason(0) == BusReason.ERROR_PASSIVE


def test_what_the_kernel_says_wins_and_a_new_interface_begins_anew() -> None:
    health = ControllerHealth()
    health.believe(BusReason.BUS_OFF)
    health.believe(BusReason.BUS_OFF)
    assert (health.reason(0), health.bus_offs) == (BusReason.BUS_OFF, 1)
    take(health, (0x4, "0001000000000000"))
    health.reset()
    assert health.reason(0) == BusReason.NONE
    assert (health.overflows, health.bus_offs) == (1, 1)


error_frame = st.tuples(
    st.integers(0, 0x1FFF_FFFF) | st.sampled_from([1 << n for n in range(10)]), st.binary(min_size=8, max_size=8)
)


@pytest.mark.thorough
@given(st.lists(error_frame, max_size=30), st.integers(0, 30))
def test_any_frames_in_any_batches_mean_the_same(frames: list[tuple[int, bytes]], cut: int) -> None:
    as_text = [(kind, payload.hex()) for kind, payload in frames]
    one, two, single = ControllerHealth(), ControllerHealth(), ControllerHealth()
    take(one, *as_text)
    take(two, *as_text[:cut])
    take(two, *as_text[cut:])
    for frame in as_text:
        take(single, frame)
    told = {(health.reason(1), health.overflows, health.bus_offs) for health in (one, two, single)}
    assert len(told) == 1


# -- the kernel's own answer --------------------------------------------------------------------------------------


def attribute(kind: int, data: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def link_message(*of_controller: bytes, kind: int = 16, errors: bytes = b"") -> bytes:
    counters = attribute(3, errors) if errors else b""
    info = attribute(1, b"can\0") + counters + attribute(2 | 0x8000, b"".join(of_controller))
    body = struct.pack("=BxHiII", 0, 280, 3, 0x100C1, 0) + attribute(3, b"can0\0") + attribute(18 | 0x8000, info)
    return struct.pack("=IHHII", 16 + len(body), kind, 0, 1, 0) + body


CONTROLLER_ERRORS = {
    "bus_error": 1,
    "error_warning": 2,
    "error_passive": 3,
    "bus_off": 4,
    "arbitration_lost": 5,
    "restarts": 6,
}


def test_a_controller_is_read_from_the_kernels_message() -> None:
    timing = struct.pack("=8I", 500_000, 875, 125, 6, 7, 2, 1, 2)
    state, restart = struct.pack("=I", 3), struct.pack("=I", 100)
    errors = struct.pack("=6I", 1, 2, 3, 4, 5, 6)  # struct can_device_stats of linux/can/netlink.h
    whole = link_message(attribute(1, timing), attribute(4, state), attribute(6, restart), errors=errors)
    kind, controller = parse_answer(whole)
    assert (kind, controller) == ("can", Controller(500_000, 3, 100, 0, 0.875, CONTROLLER_ERRORS))
    assert parse_answer(link_message(attribute(4, state))) == ("can", Controller(0, 3, 0))
    data_timing = struct.pack("=8I", 5_000_000, 750, 25, 1, 1, 1, 1, 1)
    of_fd = link_message(attribute(1, timing), attribute(4, state), attribute(9, data_timing))
    assert parse_answer(of_fd) == ("can", Controller(500_000, 3, 0, 5_000_000, 0.875))
    assert parse_answer(link_message()) == ("can", None)  # as a vcan, which has another name
    assert parse_answer(link_message(attribute(4, state), kind=2)) == ("", None)  # an error
    assert parse_answer(b"") == ("", None)


@given(st.binary(max_size=200), st.integers(0, 200))
def test_a_damaged_message_raises_nothing(noise: bytes, at: int) -> None:
    whole = link_message(attribute(1, bytes(32)), attribute(4, bytes(4)), errors=bytes(24))
    for message in (whole[:at], whole[:16] + noise, whole[:at] + noise + whole[at:]):
        kind, controller = parse_answer(message)
        assert isinstance(kind, str)
        assert isinstance(controller, Controller | None)


def test_an_interface_without_a_controller_tells_of_none() -> None:
    assert read_controller("lo") is None
    assert read_controller("no-such-if") is None


def test_an_interface_is_known_to_be_missing_without_a_search_for_its_driver() -> None:
    assert [is_missing(name) for name in ("lo", "no-such-if", "a name that is far too long for any")] == [
        False,
        True,
        False,
    ]
