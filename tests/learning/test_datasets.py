"""Datasets over recordings: their windows are what was recorded, in the memory that was read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from skinware.errors import ConfigurationError, MissingExtra
from skinware.learning import RecordedWindows, StreamedSamples, torch_dataset, torch_iterable
from tests.cli.fake_skin import fake_structure
from tests.recording.test_learning_set import physical, status_of, table_of, write

_PAGE = Path(__file__).parents[2] / "docs/how-to/learning.md"
_SNIPPET = re.compile(r"^```py\n(.*?)^```$", re.MULTILINE | re.DOTALL)
STRUCTURE = fake_structure(1, 2, dtype="<u2")


def test_windows_are_views_of_what_was_recorded(tmp_path: Path) -> None:
    made = write(tmp_path / "walk.mcap", table_of("torso", STRUCTURE, range(100)))
    windows = RecordedWindows(made.path, type_name="pressure", window=8, step=3)
    values, is_good = physical(made.tables[0], "pressure"), status_of(made.tables[0], "pressure") == 0
    assert len(windows) == (100 - 8) // 3 + 1
    for number, item in enumerate(windows):
        rows = slice(3 * number, 3 * number + 8)
        assert np.array_equal(item["values"], values[rows])
        assert (item["fresh"] <= is_good[rows]).all()
        assert np.allclose(np.diff(item["time_s"]), 0.01)
    assert np.shares_memory(windows[0]["values"], windows[1]["values"])
    assert not windows[0]["values"].flags.writeable
    assert windows.structure.n_sensors == values.shape[1]
    assert [len(item["values"]) for item in windows[-2:]] == [8, 8]
    with pytest.raises(IndexError):
        windows[len(windows)]


def test_no_window_spans_a_gap_or_two_files(tmp_path: Path) -> None:
    numbers = [*range(20), *range(60, 75), *range(80, 83)]
    one = write(tmp_path / "one.mcap", table_of("torso", STRUCTURE, numbers))
    two = write(tmp_path / "two.mcap", table_of("torso", STRUCTURE, range(10), seed=2))
    windows = RecordedWindows(one.path, two.path, type_name="pressure", window=5)
    assert len(windows) == 16 + 11 + 0 + 6
    for item in windows:
        assert np.allclose(np.diff(item["time_s"]), 0.01)
    assert np.array_equal(windows[27]["values"], physical(two.tables[0], "pressure")[:5])


def test_a_stream_has_every_sample_once_over_its_shares(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / f"{seed}.mcap", table_of("torso", STRUCTURE, range(30), seed=seed)).path for seed in range(3)
    ]
    samples = StreamedSamples(*paths, type_name="pressure")
    whole = RecordedWindows(*paths, type_name="pressure")
    assert [item["values"].tolist() for item in samples] == [item["values"][0].tolist() for item in whole]
    shares = [list(samples.share(number, 2)) for number in range(2)]
    assert [len(share) for share in shares] == [60, 30]


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    both = write(tmp_path / "both.mcap", table_of("arm", STRUCTURE, range(9)), table_of("leg", STRUCTURE, range(9)))
    other = write(tmp_path / "other.mcap", table_of("arm", fake_structure(1, 3, dtype="<u2"), range(9)))
    with pytest.raises(ConfigurationError, match="drivers with pressure: arm, leg; give driver="):
        RecordedWindows(both.path, type_name="pressure")
    with pytest.raises(ConfigurationError, match="no driver with force_z"):
        RecordedWindows(both.path, type_name="force_z")
    with pytest.raises(ConfigurationError, match="other sensors than before"):
        RecordedWindows(both.path, other.path, type_name="pressure", driver="arm")
    with pytest.raises(ConfigurationError, match="of no recording"):
        RecordedWindows(type_name="pressure")
    with pytest.raises(ConfigurationError, match="give at least 1"):
        RecordedWindows(both.path, type_name="pressure", window=0)


def test_tensors_share_the_memory_of_arrays(tmp_path: Path) -> None:
    made = write(tmp_path / "walk.mcap", table_of("torso", STRUCTURE, range(40)))
    windows, stream = (
        RecordedWindows(made.path, type_name="pressure", window=4),
        StreamedSamples(made.path, type_name="pressure"),
    )
    try:
        import torch
        import torch.utils.data
    except ImportError:
        with pytest.raises(MissingExtra, match="pip install 'torch'"):
            torch_dataset(windows)
        with pytest.raises(MissingExtra, match="pip install 'torch'"):
            torch_iterable(stream)
        return
    (snippet,) = [each for each in _SNIPPET.findall(_PAGE.read_text()) if "torch_dataset" in each]
    exec(snippet, {"torch": torch, "windows": windows})
    dataset = torch_dataset(windows)
    assert isinstance(dataset, torch.utils.data.Dataset)
    assert dataset[3]["values"].data_ptr() == windows[3]["values"].ctypes.data
    loader = torch.utils.data.DataLoader(dataset, batch_size=len(windows), num_workers=1)
    (batch,) = loader
    assert np.array_equal(batch["values"].numpy(), np.stack([item["values"] for item in windows]))
    iterable = torch_iterable(stream)
    assert isinstance(iterable, torch.utils.data.IterableDataset)
    loader = torch.utils.data.DataLoader(iterable, batch_size=None, num_workers=2)
    assert np.array_equal(
        np.stack([item["values"].numpy() for item in loader]), np.stack([item["values"] for item in stream])
    )
