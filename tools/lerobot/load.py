"""Loads learning sets with LeRobot's own loader, and compares every row with what it must be."""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

SETS = ("plain", "windows", "episodes", "camera")
FPS = 25


def main() -> None:
    folder = Path(sys.argv[1])
    print(f"lerobot {version('lerobot')}, torch {torch.__version__}, numpy {np.__version__}")
    for name in SETS:
        check(folder, name)
    check_videos(folder)


def check_videos(folder: Path) -> None:
    """Frames of a video, decoded by LeRobot, are nearly the images that they were made of."""
    dataset = LeRobotDataset("skinware/videos", root=folder / "videos", video_backend="pyav")
    images = np.load(folder / "videos.npy")
    assert len(dataset) == len(images)
    found = np.array(
        [dataset[row]["observation.images.touch"].numpy().transpose(1, 2, 0) for row in range(len(images))]
    )
    off = np.abs(found * 255 - images).mean(axis=(1, 2, 3))
    other = np.abs(np.roll(found, 1, axis=0) * 255 - images).mean(axis=(1, 2, 3))
    assert (off < other / 2).all(), (off.max(), other.min())
    print(
        f"videos: {len(found)} frames, {off.mean():.1f} of 255 off in the mean, {other.mean():.1f} from the one before"
    )


def check(folder: Path, name: str) -> None:
    """All rows of a set, one by one and as a loader gives them, and its statistics."""
    dataset = LeRobotDataset(f"skinware/{name}", root=folder / name)
    expected = dict(np.load(folder / f"{name}.npz"))
    total = len(expected["pressure"])
    assert len(dataset) == dataset.meta.total_frames == total, (len(dataset), total)
    of_episode = 0
    for row in range(total):
        item = dataset[row]
        for what, rows in expected.items():
            assert np.array_equal(item[f"observation.tactile.torso.{what}"].numpy(), rows[row]), (name, row, what)
        of_episode = of_episode if int(item["frame_index"]) else int(item["episode_index"])
        episode = dataset.meta.episodes[of_episode]
        assert int(item["index"]) == row == episode["dataset_from_index"] + int(item["frame_index"])
        assert abs(float(item["timestamp"]) - int(item["frame_index"]) / FPS) < 1e-6
        assert [item["task"]] == episode["tasks"]
        if name == "camera":
            colour = item["observation.images.top"][:, 3, 5] * 255
            assert torch.equal(colour.round(), torch.tensor([row, 255.0 - row, 7.0]))
        if name == "windows":
            time_s = (float(item["timestamp"]) * 100 + 3) / 100
            state = torch.tensor([np.sin(time_s), np.cos(time_s), time_s], dtype=torch.float32)
            assert torch.allclose(item["observation.state"], state, atol=1e-5)
            assert torch.allclose(item["action"], state[1], atol=1e-5)
    check_statistics(dataset, expected)
    past = {"observation.tactile.torso.pressure": [-2 / FPS, -1 / FPS, 0.0]}
    with_past = LeRobotDataset(f"skinware/{name}", root=folder / name, delta_timestamps=past)
    loader = torch.utils.data.DataLoader(with_past, batch_size=16, shuffle=False)
    rows = torch.cat([batch["observation.tactile.torso.pressure"][:, -1] for batch in loader]).numpy()
    assert np.array_equal(rows, expected["pressure"])
    only = LeRobotDataset(f"skinware/{name}", root=folder / name, episodes=[0])
    assert len(only) == dataset.meta.episodes[0]["length"]
    print(f"{name}: {total} rows in {dataset.meta.total_episodes} episodes equal, with loader, past and statistics")


def check_statistics(dataset: LeRobotDataset, expected: dict[str, np.ndarray]) -> None:
    """As LeRobot reads them, and as numpy finds them."""
    for what, rows in expected.items():
        told = dataset.meta.stats[f"observation.tactile.torso.{what}"]
        assert np.allclose(told["mean"], rows.mean(axis=0, dtype=np.float64), rtol=1e-5, atol=1e-5)
        assert np.allclose(told["std"], rows.std(axis=0, dtype=np.float64), rtol=1e-4, atol=1e-4)
        assert np.array_equal(told["min"], rows.min(axis=0))
        assert np.array_equal(told["max"], rows.max(axis=0))


if __name__ == "__main__":
    main()
