"""Makes recordings and learning sets of them, and says beside each what its rows must be."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware.conversion import Selection
from skinware.conversion.learning import Interval, Join, LearningSet, convert_to_learning_set
from skinware.learning.images import Colours, TouchImage, range_of
from skinware.skin_layout import SkinLayout
from skinware.tactile.regions import SensorChoice
from tests.cli.fake_skin import fake_structure
from tests.recording.made import START_NS
from tests.recording.test_learning_set import Made, physical, status_of, table_of, write, write_images

RATE_HZ, FRAMES = 100, 400


def main() -> None:
    folder = Path(sys.argv[1])
    structure = fake_structure(2, 4, dtype="<u2")
    one, two = (
        write(folder / f"{name}.mcap", table_of("torso", structure, range(FRAMES), seed=seed))
        for seed, name in enumerate(("pick", "place"))
    )
    seconds = np.arange(FRAMES) / RATE_HZ
    joints = np.stack([np.sin(seconds), np.cos(seconds), seconds], axis=1)
    head = "unix_s,hip,knee,toe"
    np.savetxt(folder / "joints.csv", np.column_stack((START_NS / 1e9 + seconds, joints)), "%.9f", ",", header=head)
    (folder / "joints.csv").write_text((folder / "joints.csv").read_text().removeprefix("# "))
    joins = [Join("observation.state", folder / "joints.csv"), Join("action", folder / "joints.csv", ("knee",))]
    camera = Join("observation.images.top", write_images(folder / "top", (np.arange(60) / 25).tolist(), (32, 24)))
    intervals = [Interval(0.5, 1.5, "grasp", "pick.mcap"), Interval(2, 3.5, "drop", "place.mcap")]
    sets = {
        "plain": ([one], LearningSet(fps=25)),
        "windows": ([one, two], LearningSet(fps=25, window=4, joins=joins, within_s=0.01, match="nearest")),
        "episodes": ([one, two], LearningSet(fps=25, intervals=intervals)),
        "camera": ([one], LearningSet(fps=25, joins=[camera], at=camera.feature)),
    }
    touch = LearningSet(fps=25, form="images", size=(48, 96), video=True)
    convert_to_learning_set([one.path], folder / "videos", touch, Selection(sensors=SensorChoice(types=["pressure"])))
    np.save(folder / "videos.npy", touch_images(one, range(0, FRAMES, 4)))
    for name, (made, wanted) in sets.items():
        convert_to_learning_set([each.path for each in made], folder / name, wanted)
    first = {"plain": [0], "windows": [3, 3], "episodes": [50, 200], "camera": [0]}
    length = {"plain": [100], "windows": [100, 100], "episodes": [25, 38], "camera": [60]}
    for name, (made, wanted) in sets.items():
        expected(folder / f"{name}.npz", made, wanted.window, first[name], length[name])


def touch_images(made: Made, numbers: range) -> npt.NDArray[np.uint8]:
    structure = made.tables[0].structure
    assert structure is not None
    layout = SkinLayout(("torso",), (structure,))
    colours = Colours("grey", *range_of(layout, "pressure"))
    image = TouchImage(layout, "pressure", np.arange(len(layout.uids("pressure"))), 48, 96, colours)
    good = np.where(status_of(made.tables[0], "pressure") == 0, physical(made.tables[0], "pressure"), 0)
    return np.array([image.of(good[number]) for number in numbers])


def expected(path: Path, made: list[Made], window: int, first: list[int], length: list[int]) -> None:
    """The rows of a set: each fourth frame from the first of each episode on."""
    values, status = [], []
    for each, begin, rows in zip(made, first, length, strict=True):
        newest = begin + np.arange(rows) * 4
        of = newest[:, np.newaxis] + np.arange(1 - window, 1)
        of = of if window > 1 else of[:, 0]
        values.append(physical(each.tables[0], "pressure")[of])
        status.append(status_of(each.tables[0], "pressure")[of])
    np.savez(path, pressure=np.concatenate(values), pressure_status=np.concatenate(status))


if __name__ == "__main__":
    main()
