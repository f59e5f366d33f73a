"""One recording, read in every way, and files that are none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

import skinware.recording
from skinware.errors import BadRecording, ConfigurationError, StructureError
from skinware.recording.mcap_writing import MAGIC
from skinware.tactile.regions import Region, Regions
from tests.commands import PATIENCE_S


def test_columns_frames_and_snapshots_tell_the_same(path: Path) -> None:
    with skinware.recording.open(path) as opened:
        torso = opened["torso"]
        series, frames = torso.read(), list(torso.samples())
        assert len(series) == len(frames) == 75
        n_pressure = int((torso.structure.sensor_type == torso.structure.type("pressure").id).sum())
        assert series.physical("pressure").shape == (75, n_pressure)
        assert series.physical("pressure").dtype == np.float32
        assert opened["arm"].read().physical("pressure").dtype == np.float64
        for row, frame in enumerate(frames):
            assert isinstance(frame, skinware.recording.RecordedDriverSnapshot)
            for of_series, of_frame in (
                (series.raw("pressure"), frame.raw("pressure")),
                (series.physical("temperature"), frame.physical("temperature")),
                (series.status_of("pressure"), frame.status_of("pressure")),
                (series.time_ns("pressure"), frame.time_ns("pressure")),
                (series.fresh("pressure"), frame.fresh("pressure")),
            ):
                assert np.array_equal(of_series[row], of_frame)
            assert (series.sequence[row], series.generation[row]) == (frame.sequence, frame.generation)
            assert (series.acquired_ns[row], series.published_ns[row]) == (frame.acquired_ns, frame.published_ns)
            assert frame.age_ns == frame.published_ns - frame.acquired_ns
        assert (np.diff(series.time_s) > 0).all()
        assert 0 < series.fresh("pressure").mean() < 1

        snapshots = list(opened.snapshots())
        assert len(snapshots) == 75 + len(opened["arm"].read())
        assert snapshots[-1].layout.drivers == ("arm", "torso")
        both = [snapshot for snapshot in snapshots if len(snapshot.samples) == 2]
        times_s = np.array([snapshot.time_s for snapshot in snapshots])
        assert (np.diff(times_s) > -0.05).all()  # across chunks, two drivers may be a look of the recorder apart
        assert both[-1].raw("pressure").shape[0] == n_pressure + opened["arm"].read().raw("pressure").shape[1]
        assert both[-1].fresh("pressure").any()
        assert both[-1].layout is both[-2].layout
        (only_arm,) = {snapshot.layout.drivers for snapshot in opened.snapshots(["arm"])}
        assert only_arm == ("arm",)


def test_a_part_of_the_time(path: Path) -> None:
    with skinware.recording.open(path) as opened:
        whole, part = opened["torso"].read(), opened["torso"].read(start_s=0.4, end_s=0.8)
        wanted = (whole.time_s >= 0.4) & (whole.time_s < 0.8)
        assert 5 < wanted.sum() < 70
        assert np.array_equal(part.column("values"), whole.column("values")[wanted])
        assert [f.sequence for f in opened["torso"].samples(start_s=0.4, end_s=0.8)] == whole.sequence[wanted].tolist()
        times = [snapshot.time_s for snapshot in opened.snapshots(start_s=0.4, end_s=0.8)]
        assert 0.4 <= min(times) <= max(times) < 0.8
        assert len(opened["torso"].read(start_s=1e6)) == 0
        assert opened["torso"].read(start_s=1e6).physical("pressure").shape[0] == 0


def test_sensors_of_a_type_or_a_region_alone(path: Path) -> None:
    palm = Regions([Region("palm", patch=("board 8", "board 10"))])
    with skinware.recording.open(path) as opened:
        torso = opened["torso"]
        whole = torso.read()
        of_type = torso.read(type_name="temperature")
        assert np.array_equal(of_type.physical("temperature"), whole.physical("temperature"))
        assert np.array_equal(of_type.fresh("temperature"), whole.fresh("temperature"))
        assert of_type.column("values").shape == of_type.column("status").shape == (75, 128)
        assert of_type.structure.n_sensors == 128
        for sensors in (palm.of(torso.structure, "pressure")["palm"], np.array([3, 17, 200]), slice(5, 9)):
            part = torso.read(type_name="pressure", sensors=sensors, start_s=0.2)
            later = whole.time_s >= 0.2
            assert np.array_equal(part.physical("pressure"), whole.physical("pressure")[later][:, sensors])
            assert np.array_equal(part.status_of("pressure"), whole.status_of("pressure")[later][:, sensors])
            assert np.array_equal(part.time_ns("pressure"), whole.time_ns("pressure")[later][:, sensors])
            uid = torso.structure.sensor_uid[torso.structure.index("pressure")][sensors]
            assert np.array_equal(part.structure.sensor_uid, uid)
        pieces = list(torso.blocks(["values"], type_name="pressure"))
        assert len(pieces) > 3
        joined = np.concatenate([piece.raw("pressure") for piece in pieces])
        assert np.array_equal(joined, whole.raw("pressure"))
        with pytest.raises(StructureError, match="no sensor type 'force'"):
            torso.read(type_name="force")
        with pytest.raises(StructureError, match="give type_name"):
            torso.read(sensors=slice(3))
        with pytest.raises(StructureError, match="at least one sensor"):
            torso.read(type_name="pressure", sensors=slice(0))
        with pytest.raises(StructureError, match="'pose' is not a driver"):
            opened["pose"].read(type_name="pressure")
        with pytest.raises(KeyError, match="no column 'x'"):
            torso.blocks(["x"])


@pytest.mark.thorough
def test_the_example(path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "recording.py"
    done = subprocess.run(
        [sys.executable, "-W", "error", example, path], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert "torso: 75 frames" in done.stdout
    assert "board 7" in done.stdout


def test_the_tools_of_others_read_it(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        topics = {channel.topic: channel.id for channel in summary.channels.values()}
        assert summary.statistics.channel_message_counts[topics["/skin/torso/frame"]] == 75
        messages = list(reader.iter_messages(topics=["/skin/torso/frame"]))
        assert [message.sequence for _, _, message in messages] == list(range(1, 76))
        assert reader.get_header().profile == "skinware"


def test_what_there_is_not(path: Path) -> None:
    with skinware.recording.open(path) as opened:
        with pytest.raises(ConfigurationError, match=r"no service 'leg' .* there are: arm, pose, torso"):
            opened["leg"]
        with pytest.raises(StructureError, match="no sensor type 'force'"):
            opened["torso"].read().physical("force")
        with pytest.raises(StructureError, match="'pose' is not a driver"):
            opened["pose"].read().physical("pressure")
        with pytest.raises(KeyError, match="no column 'x'; there are values"):
            opened["torso"].read(["x"])
        with pytest.raises(KeyError, match="'bus_load' was not read; there are values"):
            opened["torso"].read().column("bus_load")


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    def refused(data: bytes | None, words: str) -> None:
        file = tmp_path / "x.mcap"
        if data is not None:
            file.write_bytes(data)
        with pytest.raises(BadRecording, match=words) as raised:
            skinware.recording.open(file)
        assert "\n" not in str(raised.value)

    refused(b"", "empty, so not a recording")
    refused(b"hello", r"not a recording \(not an MCAP file\)")
    refused(os.urandom(200_000), r"not a recording \(not an MCAP file\)")
    with pytest.raises(FileNotFoundError):
        skinware.recording.open(tmp_path / "nothing.mcap")
    with pytest.raises(IsADirectoryError):
        skinware.recording.open(tmp_path)
    for encoding, words in (("json", "not a recording of a skin"), ("skinware/2", r"newer version \(skinware/2\)")):
        with (tmp_path / "x.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            channel = writer.register_channel("/skin/torso/frame", encoding, 0)
            writer.add_message(channel, 1, b"{}", 1)
            writer.finish()  # type: ignore[no-untyped-call]
        refused(None, words)


def again(path: Path, target: Path, **options: Any) -> None:
    """The same messages in a file that mcap's own writer makes."""
    with path.open("rb") as old, target.open("wb") as new:
        writer = Writer(new, **options)
        writer.start("skinware")
        known: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages(log_time_order=False):
            assert schema is not None
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(
                known[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]


def test_a_file_without_the_index_of_its_chunks_is_read_too(path: Path, tmp_path: Path) -> None:
    for index_types, is_whole in ((IndexType.ALL, True), (IndexType.NONE, False), (IndexType.MESSAGE, False)):
        again(path, tmp_path / "x.mcap", compression=CompressionType.ZSTD, index_types=index_types)
        with skinware.recording.open(tmp_path / "x.mcap") as opened, skinware.recording.open(path) as original:
            assert opened.is_whole is is_whole
            assert len(opened["torso"].read(["status"])) == len(original["torso"].read(["status"]))
            assert opened.problems == []


def test_a_file_that_was_compressed_otherwise_is_refused_by_name(path: Path, tmp_path: Path) -> None:
    for compression, words in ((CompressionType.LZ4, "by lz4"), (CompressionType.NONE, "by nothing")):
        again(path, tmp_path / "x.mcap", compression=compression)
        with pytest.raises(BadRecording, match=rf"x.mcap: compressed {words}; recordings are by zstd"):
            skinware.recording.open(tmp_path / "x.mcap")


def test_an_interrupted_writer_of_nothing_is_an_empty_recording(tmp_path: Path) -> None:
    file = tmp_path / "x.mcap"
    file.write_bytes(MAGIC)
    with skinware.recording.open(file) as opened:
        assert (opened.services, opened.is_whole, opened.duration_s) == ((), False, 0.0)


@pytest.mark.thorough
def test_without_the_packages_it_says_which_extra_is_needed() -> None:
    code = "import sys; sys.modules['mcap'] = None\nimport skinware.recording"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "pip install 'skinware[record]'" in done.stderr.splitlines()[-1]
