"""Write the layouts and tables of a decoder into structs for C."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.compiled import CompiledCycle, FrameKind
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import Above, Byte, Packed, Sentinel, SequenceNumber, StatusBytes
from skinware_drivers.layout import Expand, Frame
from skinware_drivers.native import structs

_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
_PACKED = len(_TYPES)
_ORDERS = ("given", "any", "ends_with")
_SENTINEL, _ABOVE, _STATUS_BYTES, _WORD = range(4)


def check_values(frame: Frame) -> None:
    """Refuse values that the data path cannot read together."""
    dtypes = [np.dtype(run.dtype) for run in frame.runs if not isinstance(run.dtype, Packed)]
    unknown = next((dtype for dtype in dtypes if dtype.str[1:] not in _TYPES), None)
    if unknown is not None:
        problem = f"values of dtype {unknown.name}"
    elif any(dtype.str[1:] in ("u8", "i8") for dtype in dtypes) and _common_dtype(frame).kind == "f":
        problem = "64-bit integers beside floats or integers of another sign"
    else:
        return
    raise ConfigurationError(f"frame {frame.name!r}: {problem} cannot be declared; read them with an Expand function")


def _common_dtype(frame: Frame) -> np.dtype[Any]:
    """Return the dtype in which the values of all runs are compared with sentinels and limits."""
    return np.result_type(*(np.int64 if isinstance(run.dtype, Packed) else run.dtype for run in frame.runs))


def compile_decoder(decoder: Decoder, plan: structs.Plan, arrays: structs.Arrays) -> None:
    """Fill in the part of a plan that is about frames and updates."""
    compiled, structure, state = decoder.compiled, decoder.tables.structure, decoder.state
    addresses = compiled.addresses
    for frame in compiled.frames:
        check_values(frame)
    plan.n_buses, plan.n_patches = len(structure.buses), structure.n_patches
    plan.n_modules, plan.n_sensors = structure.n_modules, structure.n_sensors
    plan.value_type, plan.value_bytes = _type(structure.dtype)[0], structure.dtype.itemsize
    plan.width = compiled.width

    plan.nobody = addresses.foreign
    plan.entry, plan.candidates = arrays.at(addresses.entry), arrays.at(addresses.candidates)
    plan.sets, plan.payload_names = arrays.at(addresses.sets), arrays.at(compiled.payload_names)
    plan.n_forms, plan.forms = arrays.structs(structs.Form, (_form(form, arrays) for form in addresses.forms))
    plan.length_columns, plan.length_ok = compiled.length_ok.shape[1], arrays.at(compiled.length_ok)
    if compiled.header is not None:
        plan.header_byte, plan.header = compiled.header[0], arrays.at(compiled.header[1])

    assemblies = [*compiled.alone.items()]
    made_of = [([number], assembly) for number, assembly in assemblies]
    made_of += [(cycle.members, cycle.assembly) for cycle in compiled.cycles]
    _, plan.assemblies = arrays.structs(
        structs.Assembly,
        (
            structs.Assembly(
                len(members),
                arrays.of(members, np.int64),
                arrays.at(assembly.channels),
                arrays.of(assembly.destination, np.int32),
                arrays.at(assembly.groups),
            )
            for members, assembly in made_of
        ),
    )
    kinds = [_kind(kind, decoder, arrays) for kind in compiled.kinds]
    for number, (members, assembly) in enumerate(made_of):
        for place, (member, columns) in enumerate(zip(members, assembly.columns, strict=True)):
            kind = kinds[member]
            kind.assembly, kind.place, kind.column = number, place, columns.start
            kind.cycle = number - len(assemblies) if number >= len(assemblies) else -1
            # columns of runs count from the beginning of the update, not of their frame
            for run in (structs.Run * kind.n_runs).from_address(kind.runs):
                run.column += columns.start
    plan.n_kinds, plan.kinds = arrays.structs(structs.Kind, kinds)
    plan.n_cycles, plan.cycles = arrays.structs(
        structs.Cycle,
        (_cycle(cycle, len(assemblies) + number, arrays) for number, cycle in enumerate(compiled.cycles)),
    )
    plan.module_patch = arrays.of(structure.module_patch, np.int64)
    plan.n_groups, plan.groups_are_modules = structure.n_groups, structure.groups_are_modules
    plan.most_groups = compiled.most_groups
    plan.group_module, plan.group_patch = (
        arrays.of(of, np.int64) for of in (structure.group_module, structure.group_patch)
    )
    plan.sensor_group = arrays.of(structure.sensor_group, np.int64)
    plan.first_group = arrays.of(np.searchsorted(structure.group_patch, np.arange(structure.n_patches)), np.int64)
    plan.patch_bus = arrays.of(structure.patch_bus, np.int64)
    plan.last_sequence, plan.haste = arrays.at(decoder.last_sequence), arrays.at(decoder.haste)
    plan.knows_clock, plan.clock_stops = arrays.at(decoder.knows_clock), arrays.at(decoder.clock_stops)
    if any(frame.module_flags for frame in compiled.frames):
        plan.module_flags = arrays.at(decoder.module_flags)
    plan.unknown_identifiers = arrays.at(decoder.unknown_identifiers)

    plan.values, plan.status = arrays.at(state.all_values), arrays.at(state.all_status)
    plan.group_time_ns, plan.updated = arrays.at(state.all_group_time_ns), arrays.at(state.all_updated)
    plan.patch_time_ns, plan.touched = arrays.at(state.all_patch_time_ns), arrays.at(state.all_touched)
    plan.bus_counters, plan.patch_counters = arrays.at(state.bus_counters), arrays.at(state.patch_counters)


def compile_batch(batch: FrameBatch, arrays: structs.Arrays) -> structs.Batch:
    """Return a batch as it is now; ``arrays`` keep its memory."""
    return structs.Batch(
        wire=arrays.at(batch.wire),
        time_ns=arrays.at(batch.time_ns),
        bus=arrays.at(batch.bus),
        row_bytes=batch.wire.dtype.itemsize,
        payload_size=batch.payload_size,
        headroom=batch.headroom,
        capacity=batch.capacity,
        start=batch.start,
        stop=batch.stop,
        limit=batch.limit,
    )


def _type(dtype: Any) -> tuple[int, int]:
    """Return the number of a dtype, and whether its bytes are swapped."""
    found = np.dtype(dtype)
    return _TYPES.index(found.str[1:]), found.str[0] == ">"


def _number(sequence: SequenceNumber | None) -> structs.Number:
    if sequence is None:
        return structs.Number()
    mask, shift = (-1, 0) if sequence.mask is None else (sequence.mask, sequence.shift)
    return structs.Number(1, sequence.offset, *_type(sequence.dtype), mask, shift, sequence.turn)


def _form(form: Any, arrays: structs.Arrays) -> structs.Form:
    conditions = [structs.IdentifierCondition(c.mask, c.value) for c in form.conditions]
    return structs.Form(
        form.bus,
        *arrays.structs(structs.IdentifierCondition, conditions),
        structs.Field(form.patch.shift, form.patch.mask, form.patch.constant),
        structs.Field(form.module.shift, form.module.mask, form.module.constant),
        len(form.patch_codes),
        len(form.codes),
        arrays.at(form.patch_codes),
        arrays.at(form.patch_slots),
        arrays.at(form.codes),
        arrays.at(form.slots),
    )


def _kind(compiled: FrameKind, decoder: Decoder, arrays: structs.Arrays) -> structs.Kind:
    frame = compiled.frame
    kind = structs.Kind(width=len(compiled.channels), is_expanded=isinstance(frame.values, Expand))
    kind.n_conditions, kind.conditions = arrays.structs(
        structs.ByteCondition,
        (structs.ByteCondition(c.offset, c.mask, c.value) for c in frame.when if isinstance(c, Byte)),
    )
    runs, column = [], 0
    for run in frame.runs:
        if isinstance(run.dtype, Packed):
            how = run.dtype
            packed = how.bits, how.order == "little", how.signed, how.skip
            runs.append(structs.Run(run.offset, run.count, _PACKED, 0, column, *packed))
        else:
            runs.append(structs.Run(run.offset, run.count, *_type(run.dtype), column))
        column += run.count
    kind.n_runs, kind.runs = arrays.structs(structs.Run, runs)
    values = _common_dtype(frame) if frame.runs else decoder.tables.structure.dtype
    kind.n_flags, kind.flags = arrays.structs(
        structs.Flag, (_flag(flag, values, decoder.tables, arrays) for flag in frame.flags)
    )
    bits, table = frame.module_byte, compiled.module_by_byte
    if bits is not None and bits.byte is not None and table is not None:
        kind.names_module, kind.key_byte, kind.key_shift = True, bits.byte, bits.shift
        kind.key_mask, kind.n_keys, kind.module_by_key = (1 << bits.width) - 1, table.shape[1], arrays.at(table)
    kind.sequence = _number(frame.sequence)
    if frame.time is not None:
        kind.stamp = structs.Number(1, frame.time.offset, *_type(frame.time.dtype), -1, 0, frame.time.turn)
        kind.stamp_unit_ns = frame.time.unit_s * NS_PER_S
    return kind


def _flag(flag: Any, values: np.dtype[Any], tables: SkinTables, arrays: structs.Arrays) -> structs.Flag:
    if isinstance(flag, Sentinel):
        return _compared(_SENTINEL, flag.status, flag.value, values)
    if isinstance(flag, Above):
        return _compared(_ABOVE, flag.status, flag.limit, values)
    if isinstance(flag, StatusBytes):
        return structs.Flag(form=_STATUS_BYTES, offset=flag.offset, mask=int(flag.mask))
    dtype, is_swapped = _type(flag.dtype)
    n_each, each = arrays.structs(structs.ChannelBit, (structs.ChannelBit(*pair) for pair in flag.each))
    word = {"offset": flag.offset, "type": dtype, "is_swapped": is_swapped, "mask": flag.mask, "normal": flag.normal}
    patches, keys = range(tables.structure.n_patches), flag.each_module
    of_modules = (structs.ModuleBit(tables.module_key.get((p, key), -1), shift) for p in patches for key, shift in keys)
    _, modules = arrays.structs(structs.ModuleBit, of_modules)
    word |= {"n_modules": len(keys), "modules": modules}
    return structs.Flag(form=_WORD, status=int(flag.status), n_each=n_each, each=each, **word)


def _compared(form: int, status: Status, number: float, values: np.dtype[Any]) -> structs.Flag:
    found = structs.Flag(form=form, status=int(status))
    number = number.item() if isinstance(number, np.generic) else number
    if values.kind == "f":
        found.is_float, found.real = True, float(values.type(number))
    elif isinstance(number, float):
        found.is_float, found.real = True, number
    elif not np.iinfo(values).min <= number <= np.iinfo(values).max:
        found.is_float, found.real = True, math.copysign(math.inf, number)
    else:
        found.integer = number if number < 1 << 63 else number - (1 << 64)
    return found


def _cycle(cycle: CompiledCycle, assembly: int, arrays: structs.Arrays) -> structs.Cycle:
    punctuality = cycle.punctuality
    found = structs.Cycle(len(cycle.members), _ORDERS.index(cycle.order), cycle.maximum_age_ns, assembly)
    found.has_counter = bool(cycle.counters)
    _, found.counters = arrays.structs(structs.Number, (_number(counter) for counter in cycle.counters))
    found.group_of_entry = arrays.at(cycle.group_of_entry)
    found.compared_member = -1
    if cycle.sequence is not None:
        found.compared_member, found.compared = cycle.sequence[0], _number(cycle.sequence[1])
    if punctuality is not None:
        found.is_timed, found.all_as_they_should = True, punctuality.all_as_they_should
        found.period_ns, found.reach_ns = punctuality.period_ns, punctuality.reach_ns
        found.margin_ns, found.soon_ns = punctuality.margin_ns, punctuality.soon_ns
        found.last_ns, found.spacing_ns = arrays.at(punctuality.last_ns), arrays.at(punctuality.spacings_ns)
    return found
