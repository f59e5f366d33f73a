"""The structures of ``path.h`` and ``inside.h``, field by field: every field has 8 bytes."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.wire_tap import Kept

_WHOLE, _POINTER, _REAL = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double


def _fields(names: str, kind: type[Any] = _WHOLE) -> list[tuple[str, type[Any]]]:
    return [(name, kind) for name in names.split()]


class ByteCondition(ctypes.Structure):
    """A condition on a payload byte."""

    _fields_ = _fields("offset mask value")


class IdentifierCondition(ctypes.Structure):
    """A condition on an identifier."""

    _fields_ = _fields("mask value")


class Field(ctypes.Structure):
    """Bits of an identifier."""

    _fields_ = _fields("shift mask constant")


class Form(ctypes.Structure):
    """29-bit identifiers of one bus that are built alike."""

    _fields_ = [
        *_fields("bus n_conditions"),
        *_fields("conditions", _POINTER),
        ("patch", Field),
        ("module", Field),
        *_fields("n_patch_codes n_codes"),
        *_fields("patch_codes patch_slots codes slots", _POINTER),
    ]


class Number(ctypes.Structure):
    """A number in a payload that a device counts up."""

    _fields_ = _fields("is_there offset type is_swapped mask shift turn")


class Run(ctypes.Structure):
    """Values that lie side by side in a payload."""

    _fields_ = _fields("offset count type is_swapped column bits is_little is_signed skip")


class ChannelBit(ctypes.Structure):
    """A bit of a word that flags one channel."""

    _fields_ = _fields("channel shift")


class Flag(ctypes.Structure):
    """What sets status bits."""

    _fields_ = [
        *_fields("form status offset type is_swapped mask normal n_each"),
        *_fields("each", _POINTER),
        *_fields("is_float integer"),
        *_fields("real", _REAL),
    ]


class Kind(ctypes.Structure):
    """A kind of frame."""

    _fields_ = [
        *_fields("n_conditions"),
        *_fields("conditions", _POINTER),
        *_fields("width column assembly cycle place is_expanded n_runs"),
        *_fields("runs", _POINTER),
        *_fields("n_flags"),
        *_fields("flags", _POINTER),
        *_fields("names_module key_byte key_shift key_mask n_keys"),
        *_fields("module_by_key", _POINTER),
        ("sequence", Number),
    ]


class Assembly(ctypes.Structure):
    """What makes one update of a module."""

    _fields_ = [*_fields("n_members"), *_fields("members channels destination groups", _POINTER)]


class Cycle(ctypes.Structure):
    """Frames that only count together."""

    _fields_ = [
        *_fields("n order maximum_age_ns assembly has_counter"),
        *_fields("counters group_of_entry", _POINTER),
        *_fields("compared_member"),
        ("compared", Number),
        *_fields("is_timed all_as_they_should period_ns reach_ns margin_ns soon_ns"),
        *_fields("last_ns spacing_ns", _POINTER),
    ]


class Batch(ctypes.Structure):
    """A :class:`skinware_drivers.bus.FrameBatch`."""

    _fields_ = [
        *_fields("wire time_ns bus", _POINTER),
        *_fields("row_bytes payload_size headroom capacity start stop limit"),
    ]


class Columns(ctypes.Structure):
    """Where the columns of a slot begin."""

    _fields_ = _fields(
        "values status module_time_ns group_time_ns module_untouched patch_state bus_state bus_reason bus_since_ns"
        " bus_load bus_samples bus_counters patch_counters patch_interval_counts patch_age_counts latency_ns"
        " data_path bus_data_path"
    )


HEAR = ctypes.CFUNCTYPE(None)
OFFER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)
KEEP = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64)
EXPAND = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
PUBLISHED = ctypes.CFUNCTYPE(None, ctypes.c_int64)
SORT_OUT = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
LOSE = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)
DAMAGED = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64)


class Hooks(ctypes.Structure):
    """What only Python can do."""

    _fields_ = [
        ("hear", HEAR),
        ("tell_times", HEAR),
        ("offer", OFFER),
        ("keep", KEEP),
        ("expand", EXPAND),
        ("look", OFFER),
        ("published", PUBLISHED),
        ("sort_out", SORT_OUT),
        ("lose", LOSE),
        ("heard", HEAR),
        ("damaged", DAMAGED),
    ]


class Plan(ctypes.Structure):
    """All of one generation."""

    _fields_ = [
        *_fields("n_buses n_patches n_modules n_groups n_sensors value_type value_bytes width"),
        *_fields("nobody n_kinds n_forms length_columns header_byte"),
        *_fields("entry candidates sets payload_names forms length_ok header kinds", _POINTER),
        *_fields("n_cycles most_groups groups_are_modules"),
        *_fields("assemblies cycles module_patch group_module group_patch sensor_group first_group", _POINTER),
        *_fields("is_prompt age_limit_ns", _POINTER),
        *_fields("last_sequence haste unknown_identifiers sample_next_ns interrupted", _POINTER),
        *_fields("values status group_time_ns patch_time_ns updated touched bus_counters patch_counters", _POINTER),
        *_fields("period_ns patience_ns pause_ns silence_ns by_cycle most_at_once idle_ns n_counts n_own_counts"),
        *_fields("stale state_live state_stale"),
        *_fields("burst_pause_ns standing_out_ns gap_ns group_heard_ns patch_heard_ns patch_lives_until_ns", _POINTER),
        *_fields(
            "patch_state module_status module_untouched bus_state bus_reason bus_samples bus_since_ns bus_load",
            _POINTER,
        ),
        *_fields("bus_samples_bytes"),
        *_fields("latency_ns data_path bus_data_path", _POINTER),
        *_fields("counts skipped skipped_before patch_bus", _POINTER),
        *_fields("skipped_column lost_column frames_column errors_column refused_column bytes_column"),
        *_fields("timing timing_before_ns", _POINTER),
        ("columns", Columns),
        ("hooks", Hooks),
        *_fields("n_awaited"),
        *_fields("awaited", _POINTER),
    ]


class Words(ctypes.Structure):
    """What Python sees and sets between calls."""

    _fields_ = _fields(
        "fixed_ns carried n_held newest_ns due_ns not_before_ns last_published_ns on_request wanted_ns"
        " hastened store sequence must_leave expects_data entry kind ring read_ns sees_all"
    )


class Checksum(ctypes.Structure):
    """How a checksum is computed; size 0: there is none."""

    _fields_ = [
        *_fields("form size is_big width init mask xor_out is_negative is_reversed"),
        *_fields("table", _POINTER),
    ]


class WireField(ctypes.Structure):
    """A whole number in the header of a frame; size 0: there is none."""

    _fields_ = _fields("offset size is_big mask")


class Framing(ctypes.Structure):
    """How frames lie in a stream of bytes."""

    _fields_ = [
        *_fields("form body_start shortest longest"),
        ("checksum", Checksum),
        ("identifier", WireField),
        *_fields("delimiter escape longest_segment"),
        *_fields("meaning", _POINTER),
        *_fields("n_sync n_trailer"),
        *_fields("sync trailer", _POINTER),
        ("length", WireField),
        *_fields("more bare"),
        *_fields("totals", _POINTER),
        *_fields("behind known_from look_ahead confirms_each checksum_at covered_from covered_to"),
    ]


class Reading(ctypes.Structure):
    """When the bytes of a stream up to a place came."""

    _fields_ = _fields("end time_ns")


class Stream(ctypes.Structure):
    """A stream of bytes in which C finds frames."""

    _fields_ = [
        *_fields("framing", _POINTER),
        *_fields("fd payload_size"),
        *_fields("bytes content", _POINTER),
        *_fields("size place before follows_at is_discarding is_behind"),
        *_fields("reads", _POINTER),
        *_fields("n_reads"),
        *_fields("chunk", _POINTER),
        *_fields("chunk_bytes is_good is_damaged frames too_long"),
        *_fields("bytes_in frame_bytes idle_bytes skipped_bytes found checksum_errors bad_form"),
    ]


class AskedBlock(ctypes.Structure):
    """Registers that make one frame."""

    _fields_ = [*_fields("registers heard_ns told_ns", _POINTER), *_fields("count identifier")]


class AskedRead(ctypes.Structure):
    """One question for registers, and the beginning of its reply."""

    _fields_ = [
        *_fields("question reply registers", _POINTER),
        *_fields("question_bytes reply_head reply_bytes count n_blocks"),
        *_fields("heard_ns blocks", _POINTER),
    ]


class Asker(ctypes.Structure):
    """A Modbus master."""

    _fields_ = [
        *_fields("fd guests_fd is_tcp is_stuck n_reads most_blocks"),
        *_fields("reads", _POINTER),
        *_fields("open next number cycle until_ns free_ns cycle_ns deadline_ns timeout_ns turnaround_ns period_ns"),
        *_fields("sent polls_missed frames bytes_in frame_bytes found"),
        *_fields("buffer", _POINTER),
        *_fields("size"),
        *_fields("crc_table", _POINTER),
    ]


class Source(ctypes.Structure):
    """A socket, a serial line or a line on which we ask, that C reads."""

    _fields_ = [
        *_fields("fd bus"),
        *_fields("stream asker tap", _POINTER),
        *_fields("headers control offset_ns last_poll_ns lost_before lost frames heard_ns"),
        *_fields("is_counted is_watched is_small"),
        *_fields("speed_up wire_bits fullest", _REAL),
    ]


class Flow(ctypes.Structure):
    """The loop that takes, publishes and rests."""

    _fields_ = [
        *_fields("loop_fd epoll_fd until_ns latency_ns has_others rest_until_ns silence_ns n_sources"),
        *_fields("sources", _POINTER),
    ]


UPDATE = np.dtype(
    [(name, np.int64) for name in ["module", "row", "whole", "is_flagged", "oldest_ns", "newest_ns", "group", "groups"]]
)
"""An update; its sensors (int32), values and status (uint8) follow."""

SIZES = (
    *(
        ctypes.sizeof(each)
        for each in (
            *(Plan, Words, Batch, Kind, Flag, Run, Form, Cycle, Number, Assembly, Flow, Source, Framing, Stream),
            *(Asker, AskedRead, AskedBlock),
        )
    ),
    ctypes.sizeof(Kept),
    UPDATE.itemsize,
)
"""As ``skinware_path_size`` tells them."""


class Arrays:
    """Memory that C code refers to by address, kept for as long as this is."""

    def __init__(self) -> None:
        self._kept: list[object] = []

    def at(self, array: npt.NDArray[Any]) -> int:
        """Address of an array that Python goes on with.

        Raises:
            ValueError: its elements do not lie one after the other.
        """
        if not array.flags.c_contiguous:
            raise ValueError(f"an array of {array.shape} {array.dtype} whose elements lie apart")
        self._kept.append(array)
        return array.ctypes.data

    def of(self, values: npt.ArrayLike, dtype: npt.DTypeLike) -> int:
        return self.at(np.array(values, dtype, order="C"))

    def structs(self, kind: type[Any], rows: Iterable[Any]) -> tuple[int, int]:
        found = list(rows)
        memory = (kind * max(1, len(found)))(*found)
        self._kept.append(memory)
        return len(found), ctypes.addressof(memory)
