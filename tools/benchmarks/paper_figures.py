"""The article's figures 3 to 5: box plots of the worst execution times of writers and readers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

_FIGURES = (
    ("figure3-drivers", "drivers", "Drivers"),
    ("figure4-users", "users", "User applications"),
    ("figure5-buffers", "buffers", "Communication buffers"),
)
_PANELS = (("writer_worst_us", "Writers"), ("reader_worst_us", "Readers"))


def draw(rows: Sequence[Mapping[str, str]], folder: Path) -> list[Path]:
    """Draw what there is of the periodic trials.

    Returns:
        The PNG files.

    Raises:
        ImportError: matplotlib is not installed (extra ``bench``).
    """
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot

    paths = []
    for file_name, column, title in _FIGURES:
        figure, panels = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
        for panel, (what, who) in zip(panels, _PANELS, strict=True):
            boxes: dict[int, list[float]] = defaultdict(list)
            for row in rows:
                if row["readers"] == "periodic":
                    boxes[int(row[column])].append(float(row[what]))
            places = sorted(boxes)
            panel.boxplot([boxes[place] for place in places], positions=places, widths=0.6)
            panel.set_title(who)
            panel.set_xlabel(title)
            panel.set_ylabel("Worst execution time of a trial (µs)")
            panel.set_ylim(bottom=0)
            panel.grid(axis="y", alpha=0.3)
        path = folder / f"{file_name}.png"
        figure.savefig(path, dpi=150)
        pyplot.close(figure)
        paths.append(path)
    return paths
