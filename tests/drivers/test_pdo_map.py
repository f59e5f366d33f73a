"""What the TPDOs of CANopen nodes mean."""

from __future__ import annotations

from typing import Any

import canopen
import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.can.canopen_objects import Entry, PdoMap, Tpdo, default_tpdos
from skinware_drivers.description import assemble
from tests.drivers.bench import EXAMPLE_EDS
from tests.specification.decoding import SpecifiedDecoder

U8, I8, U16, I16, U32, I32, REAL32, BOOLEAN = 5, 2, 6, 3, 7, 4, 8, 1


def dictionary(**objects: tuple[int, int]) -> canopen.ObjectDictionary:
    """Objects by name: (index, data type)."""
    made = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for name, (index, data_type) in objects.items():
        variable = canopen.objectdictionary.ODVariable(name.replace("_", " "), index)
        variable.data_type = data_type
        made.add_object(variable)
    return made


def tpdo(number: int, cob_id: int, *entries: tuple[int, int]) -> Tpdo:
    made = Tpdo.make(number, cob_id, 255, [index << 16 | bits for index, bits in entries])
    assert made is not None
    return made


def decoded(made: PdoMap, *frames: tuple[int, str]) -> SpecifiedDecoder:
    decoder = SpecifiedDecoder([made.layout], assemble([("bus", made.patches)], made.types, made.dtype))
    batch = FrameBatch(100, 8, decoder.compiled.headroom)
    for identifier, payload in frames:
        batch.append(0, 1, identifier, bytes.fromhex(payload))
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


@pytest.mark.parametrize(
    ("data_type", "bits", "payload", "values", "dtype"),
    [
        (U8, 8, "00FF", [0, 255], np.uint8),
        (I8, 8, "7F80", [127, -128], np.int16),
        (U16, 16, "FEFF0100", [65534, 1], np.uint16),
        (I16, 16, "FEFF0080", [-2, -32768], np.int16),
        (I32, 32, "FEFFFFFF00000080", [-2, -(2**31)], np.int32),
        (U32, 32, "000000010000F000", [2**24, 0xF00000], np.float32),
        (REAL32, 32, "0000C03F000020C1", [1.5, -10.0], np.float32),
    ],
)
def test_objects_of_every_type(data_type: int, bits: int, payload: str, values: list[float], dtype: Any) -> None:
    objects = dictionary(taxel_1=(0x6000, data_type), taxel_2=(0x6001, data_type))
    made = PdoMap(objects, {3: [tpdo(1, 0x183, (0x6000, bits), (0x6001, bits))]}, "pressure")
    assert made.dtype == dtype
    decoder = decoded(made, (0x183, payload))
    assert decoder.state.values.tolist() == values
    assert not decoder.state.status.any()


def test_objects_of_different_lengths_in_one_tpdo() -> None:
    objects = dictionary(a=(0x6000, U16), b=(0x6001, I8), temperature=(0x6002, I16), c=(0x6003, U8), flag=(6, BOOLEAN))
    mapped = ((0x6001, 8), (0x6000, 12), (6, 4), (0x6003, 3), (0x6002, 13), (0x6000, 16))
    made = PdoMap(objects, {3: [tpdo(1, 0x183, *mapped[:5])]}, "proximity")
    bits = (-5 & 0xFF) | 0xABC << 8 | 0xF << 20 | 5 << 24 | (-1000 & 0x1FFF) << 27
    decoder = decoded(made, (0x183, bits.to_bytes(5, "little").hex()))
    assert decoder.state.values.tolist() == [-5, 0xABC, 5, -1000]
    assert [t.name for t in made.types] == ["proximity", "temperature"]
    assert len(made.patches[0].modules[0].channels) == 5


def test_what_is_no_number_of_the_eds_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    made = PdoMap(dictionary(a=(0x6000, U8)), {3: [tpdo(1, 0x183, (0x7000, 8), (0x6000, 8))]}, "pressure")
    assert "object 7000:0 is mapped, but no number" in caplog.text
    assert decoded(made, (0x183, "0907")).state.values.tolist() == [7]
    with pytest.raises(ConfigurationError, match="none of the objects"):
        PdoMap(dictionary(), {3: [tpdo(1, 0x183, (0x7000, 8))]}, "pressure")


def test_identifiers_of_any_kind() -> None:
    objects = dictionary(a=(0x6000, U8), b=(0x6001, U8))
    nodes = {
        3: [tpdo(1, 0x183, (0x6000, 8)), tpdo(2, 0x7A0, (0x6001, 8))],
        4: [tpdo(1, 0x184, (0x6000, 8)), tpdo(2, 1 << 29 | 0x18DA0104, (0x6001, 8))],
    }
    made = PdoMap(objects, nodes, "pressure")
    frames = [(0x7A0, "02"), (0x184, "03"), (EXTENDED_FLAG | 0x18DA0104, "04"), (0x183, "01")]
    decoder = decoded(made, *frames, (0x185, "09"), (0x18DA0104 & 0x7FF, "09"))
    assert decoder.state.values.tolist() == [1, 2, 3, 4]
    assert decoder.state.bus_counters[0, :3].tolist() == [2, 0, 0]
    assert len(made.layout.frames) == 3  # both TPDO 1 are alike


def test_nodes_that_map_the_same_identifiers_differently() -> None:
    objects = dictionary(a=(0x6000, U8), b=(0x6001, U16))
    nodes = {3: [tpdo(1, 0x183, (0x6000, 8))], 4: [tpdo(1, 0x184, (0x6001, 16))]}
    decoder = decoded(PdoMap(objects, nodes, "pressure"), (0x183, "07"), (0x184, "0102"), (0x184, "07"))
    assert decoder.state.values.tolist() == [7, 0x0201]
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 1, 0]


def test_tpdos_that_are_not_in_use() -> None:
    assert Tpdo.make(1, 1 << 31 | 0x183, 255, [0x60000008]) is None
    assert Tpdo.make(1, 0x183, 255, []) is None
    assert Tpdo.make(1, 0x183, 255, [0x60010310]) == Tpdo(1, 0x183, 255, (Entry(0x6001, 3, 16),))


def test_the_example_eds() -> None:
    made = PdoMap(
        canopen.import_od(str(EXAMPLE_EDS), 5), {5: default_tpdos(canopen.import_od(str(EXAMPLE_EDS), 5))}, "pressure"
    )
    (pressure, temperature) = made.types
    assert (pressure.name, pressure.unit, pressure.minimum, pressure.maximum) == ("pressure", "counts", 0, 4095)
    assert (temperature.name, temperature.unit, temperature.scale) == ("temperature", "degC", 0.1)
    assert (temperature.minimum, temperature.maximum) == (-40, 125)
    decoder = decoded(made, (0x485, "0D000E000F00E7FF"), (0x185, "0100020003000400"))
    assert decoder.state.values.tolist() == [1, 2, 3, 4, *[0] * 8, 13, 14, 15, -25]
    assert decoder.tables.structure.sensor_uid[-1] == 5 << 24 | 0x6010 << 8
