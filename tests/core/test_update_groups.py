"""Readers judge each sensor by the time and the period of its update group: Python, C, recordings, cuts."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader, DriverWriter, Structure
from skinware.bridge.parts import Cut
from skinware.errors import StructureError
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import status_now
from skinware.transfer.generation import Generation, RecordedDriverSnapshot
from skinware_drivers.testing.waiting import wait_until
from tests.compiling import compiled
from tests.core.c_programs import structure as plain
from tests.recording.made import generation_of_driver
from tests.recording.rig import recording

MS = 1_000_000
PROGRAM = r"""
#define SKINWARE_IMPLEMENTATION
#include "skinware.h"
#include <stdio.h>
int main(void) {
    skinware_reader *reader;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    uint32_t positions[5] = {0, 1, 2, 3, 4};
    unsigned char fresh[5];
    size_t i;
    if (skinware_attach(&reader, NULL, "groups") || skinware_read(reader, &frame))
    {
        fprintf(stderr, "%s\n", skinware_reason());
        return 1;
    }
    skinware_fresh(reader, &frame, 0, positions, 5, fresh);
    for (i = 0; i < 5; i++)
        printf("%d", fresh[i]);
    skinware_frame_free(&frame);
    skinware_detach(reader);
    return 0;
}
"""


def grouped() -> Structure:
    """Of a module of three taxels, a thermometer and a strain gauge, the thermometer comes alone, once a second."""
    return plain(2).replace(
        sensor_group=[0, 0, 0, 1, 0, 2, 2, 2, 3, 2],
        group_module=[0, 0, 1, 1],
        group_period_ns=[0, NS_PER_S, 0, NS_PER_S],
    )


def said(program: Path) -> str:
    done = subprocess.run([program], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def structure_of(generation: Generation) -> Structure:
    assert isinstance(generation.context, Structure)
    return generation.context


def write(writer: DriverWriter, ages_ms: Sequence[int]) -> int:
    time_ns = now_ns()
    columns = writer.begin()
    columns["status"][:] = 0
    columns["group_time_ns"][:] = time_ns - np.array(ages_ms) * MS
    columns["module_time_ns"][:] = np.minimum.reduceat(columns["group_time_ns"], [0, 2])
    return writer.commit(time_ns)


def test_fresh_is_as_each_group_has_it() -> None:
    with DriverWriter("groups", grouped(), rate_hz=100) as writer, DriverReader("groups") as reader:
        write(writer, [1500, 1500, 0, 0])
        frame = reader.read()
        assert not frame.fresh("pressure", at_ns=frame.acquired_ns)[:3].any()
        assert frame.fresh("pressure", at_ns=frame.acquired_ns)[3:].all()
        assert frame.fresh("temperature", at_ns=frame.acquired_ns).all()
        assert frame.fresh("temperature", at_ns=frame.acquired_ns + 1400 * MS).all()
        assert not frame.fresh("temperature", at_ns=frame.acquired_ns + 3100 * MS).any()
        assert frame.fresh("temperature", at_ns=frame.acquired_ns, max_age_s=1.0).tolist() == [False, True]
        assert (frame.sensor_time_ns == frame.group_time_ns[frame.structure.sensor_group]).all()
        assert frame.time_ns("temperature").tolist() == frame.group_time_ns[[1, 3]].tolist()
        assert (status_now("live", frame) != 0).tolist()[:5] == [True, True, True, False, True]


@pytest.mark.thorough
def test_c_judges_as_python_does(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    source = tmp_path / "fresh.c"
    source.write_text(PROGRAM)
    program = compiled(source, "sanitized", tmp_path_factory)
    slow = grouped().replace(group_period_ns=[0, 100 * NS_PER_S, 0, 100 * NS_PER_S])  # a program takes time to start
    with DriverWriter("groups", slow, rate_hz=0.1) as writer:
        write(writer, [60_000, 150_000, 0, 0])
        assert said(program) == "00010"
        write(writer, [0, 400_000, 0, 0])
        assert said(program) == "11101"
        write(writer, [-3_600_000, 0, 0, 0])
        assert said(program) == "00010"


def test_a_recording_keeps_them(tmp_path: Path) -> None:
    path = tmp_path / "groups.mcap"
    with DriverWriter("groups", grouped(), rate_hz=100) as writer:
        with recording(path) as recorder:
            write(writer, [1500, 1500, 0, 0])
            wait_until(lambda: recorder.messages.get("/skin/groups/frame", 0) > 0)
    with skinware.recording.open(path) as opened:
        series = opened["groups"].read()
        assert series.fresh("pressure")[-1].tolist() == [False] * 3 + [True] * 3
        assert series.fresh("temperature")[-1].all()


def test_what_is_cut_out_keeps_its_groups() -> None:
    whole = generation_of_driver("groups", grouped())
    frame = RecordedDriverSnapshot(whole, memoryview(np.zeros(whole.slot_stride, np.uint8).data))
    frame.column("group_time_ns")[:] = [10, 20, 30, 40]
    frame.column("module_time_ns")[:] = [10, 30]
    taxels = Cut(whole, np.array([0, 1, 5]))
    assert taxels.frame(frame).sensor_time_ns.tolist() == [10, 10, 30]
    thermometer = Cut(whole, np.array([8]))
    cut = thermometer.frame(frame)
    assert cut.sensor_time_ns.tolist() == [40]
    assert cut.structure.age_limits_ns(10 * MS).tolist() == [3 * NS_PER_S]
    assert structure_of(whole.only(slice(3, 5))).age_limits_ns(10 * MS).tolist() == [3 * NS_PER_S, 200 * MS]


def test_plain_structures_have_no_tables_of_groups() -> None:
    made = plain(2)
    assert made.groups_are_modules
    assert Structure.from_columns(made.to_columns(), made.dtype) == made
    own = grouped()
    assert Structure.from_columns(own.to_columns(), own.dtype) == own != made


def test_groups_that_contradict_the_rest_are_refused() -> None:
    with pytest.raises(StructureError, match="group of another module"):
        grouped().replace(sensor_group=[0] * 10)
    with pytest.raises(StructureError, match="order of their modules"):
        grouped().replace(group_module=[0, 0, 1, 0])
    with pytest.raises(StructureError, match="at most a day"):
        grouped().replace(group_period_ns=[0, 0, 0, 1 << 62])
