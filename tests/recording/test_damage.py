"""Damaged recordings: no crash, every undamaged chunk read, nothing false shown; made whole again."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.reader import make_reader

import skinware.recording
from skinware.errors import BadRecording
from skinware.recording.files import recover
from skinware.recording.mcap_reading import McapSource
from tests.recording.damaging import Original, frames_of, recover_too, with_a_bad_chunk
from tests.recording.rig import two_drivers_and_a_service

DAMAGES = 120


@pytest.fixture
def original(tmp_path: Path, made: dict[str, bytes]) -> Original:
    file = tmp_path / "original.mcap"
    if not made:
        two_drivers_and_a_service(file)
        made["skin"] = file.read_bytes()
    file.write_bytes(made["skin"])
    return Original(file)


@pytest.mark.thorough
def test_damage_costs_the_chunk_in_which_it_is(original: Original, tmp_path: Path) -> None:
    generator = random.Random(7)
    found = [original.check(generator, tmp_path / "damaged.mcap") for _ in range(DAMAGES)]
    assert sum(found) > 0.25 * DAMAGES * len(original.frames)  # so that much is asked for at all
    assert min(found) < len(original.frames)


@pytest.mark.thorough
def test_a_file_that_is_cut_off_is_made_whole(original: Original, tmp_path: Path) -> None:
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    for size in (len(original.data) - 1, len(original.data) - 500, len(original.data) * 2 // 3):
        cut.write_bytes(original.data[:size])
        with skinware.recording.open(cut) as opened:
            assert not opened.is_whole
            assert opened.problems == []
        kept = frames_of(cut)
        recovered = recover(cut, whole)
        assert not recovered.was_whole
        assert recovered.damaged == 0
        assert frames_of(whole) == kept
        with skinware.recording.open(whole) as opened:
            assert opened.is_whole
        with whole.open("rb") as stream:
            messages = list(make_reader(stream, validate_crcs=True).iter_messages(topics=["/skin/torso/frame"]))
        assert len(messages) == recovered.messages["/skin/torso/frame"] == sum(name == "torso" for name, *_ in kept)
        whole.unlink()
    assert sorted(tmp_path.iterdir()) == [cut, tmp_path / "original.mcap"]


@pytest.mark.thorough
def test_what_is_damaged_is_left_out_when_it_is_made_whole(original: Original, tmp_path: Path) -> None:
    generator = random.Random(11)
    file, whole = tmp_path / "damaged.mcap", tmp_path / "whole.mcap"
    for _ in range(15):
        original.check(generator, file)
        try:
            kept = frames_of(file)
        except BadRecording:
            kept = {}
        assert recover_too(file, whole) == kept
        whole.unlink(missing_ok=True)


def test_damage_is_told(original: Original, tmp_path: Path) -> None:
    file = tmp_path / "damaged.mcap"
    file.write_bytes(with_a_bad_chunk(tmp_path / "original.mcap"))
    with skinware.recording.open(file) as opened:
        list(opened["torso"].samples())
        assert opened.problems == ["1 chunk damaged and left out"]
    assert recover(file, tmp_path / "whole.mcap").damaged == 1


@pytest.mark.thorough
@pytest.mark.parametrize("is_cut", [False, True])
def test_damaged_times_before_a_chunk_change_nothing(original: Original, tmp_path: Path, is_cut: bool) -> None:
    """They are covered by no checksum, and told elsewhere too."""
    file = tmp_path / "damaged.mcap"
    with McapSource(tmp_path / "original.mcap") as source:
        places = source.chunks[1:3]
    with skinware.recording.open(tmp_path / "original.mcap") as opened:
        times_ns = opened.start_ns, opened.end_ns
    for offset in (9, 17):  # behind opcode and length: times of the first and the last message
        for number in (0, 1 << 40, (1 << 63) + 5):
            data = bytearray(original.data[:-1] if is_cut else original.data)
            for place in places:
                data[place.offset + offset : place.offset + offset + 8] = number.to_bytes(8, "little")
            file.write_bytes(data)
            assert frames_of(file) == original.frames
            with skinware.recording.open(file) as opened:
                assert (opened.start_ns, opened.end_ns) == times_ns
                assert opened.is_whole is not is_cut


@pytest.mark.thorough
def test_a_chunk_that_lost_its_checksum_is_not_believed(original: Original, tmp_path: Path) -> None:
    file = tmp_path / "damaged.mcap"
    with McapSource(tmp_path / "original.mcap") as source:
        place = source.chunks[len(source.chunks) // 2]
    for data in (bytearray(original.data), bytearray(original.data[:-1])):
        data[place.offset + 33 : place.offset + 37] = bytes(4)
        for at in (place.compressed_at + place.compressed_size * part // 8 for part in range(1, 8)):
            damaged = data.copy()
            damaged[at] ^= 1
            file.write_bytes(damaged)
            found = frames_of(file)
            assert all(original.frames[position] == contents for position, contents in found.items())
            with skinware.recording.open(file) as opened:
                list(opened["torso"].samples())
                assert opened.problems == ["1 chunk damaged and left out"]


def test_frames_without_their_generation_are_left_out_and_told(original: Original, tmp_path: Path) -> None:
    file = tmp_path / "damaged.mcap"
    data = bytearray(original.data)
    with McapSource(tmp_path / "original.mcap") as source:
        for place in source.chunks:
            channels = {source.channels[channel].topic for channel in place.channel_ids or ()}
            if "/skin/torso/generation" in channels:
                data[place.compressed_at + 40] ^= 1
    file.write_bytes(data)
    with skinware.recording.open(file) as opened:
        assert list(opened["torso"].samples()) == []
        assert "samples of 'torso' left out: their description is lost" in opened.problems
        with pytest.raises(BadRecording, match="the description of the samples of 'torso' is lost"):
            opened["torso"].read()


def test_it_takes_its_own_place_and_no_others(original: Original, tmp_path: Path) -> None:
    file, other = tmp_path / "original.mcap", tmp_path / "other.mcap"
    file.write_bytes(original.data[:-1])
    other.write_text("mine")
    with pytest.raises(FileExistsError):
        recover(file, other)
    assert other.read_text() == "mine"
    recover(file, file)
    with skinware.recording.open(file) as opened:
        assert opened.is_whole
    assert frames_of(file) == original.frames
    file.write_bytes(original.data[:8])
    with pytest.raises(BadRecording, match="nothing in it can be used"):
        recover(file, tmp_path / "new.mcap")
    assert sorted(tmp_path.iterdir()) == [file, other]
