"""Print what a recorded skin felt: for each driver its samples, its busiest patches and its strongest moment.

``python examples/recording.py walk.mcap``; needs ``pip install 'skinware[record]'``. As arrays throughout: each line
works in a notebook too.
"""

from __future__ import annotations

import sys

import numpy as np

import skinware.recording


def main(path: str) -> None:
    with skinware.recording.open(path) as recording:
        print(f"{path}: {recording.duration_s:.1f} s, {recording.missed} samples missed")
        for name in recording.drivers:
            for part in recording[name].parts:  # several where the driver came back with other sensors
                tell(name, part)


def tell(name: str, part: skinware.recording.Track) -> None:
    """The first type of sensors of a driver, or of as long as it had the same ones."""
    type_name = part.structure.types[0].name
    series = part.read(type_name=type_name)
    structure = series.structure
    fresh = series.fresh(type_name)  # (frames, sensors) bool
    values = np.where(fresh, series.physical(type_name), np.nan)  # (frames, sensors), in its unit
    print(f"{name}: {len(series)} frames of {structure.n_sensors} {type_name} sensors, {fresh.mean():.0%} good")

    seen = fresh.any(axis=0)
    rest = np.full(structure.n_sensors, np.nan)
    rest[seen] = np.nanmedian(values[:, seen], axis=0)  # what most of the time is
    change = np.nan_to_num(abs(values - rest))  # pressure may count downwards
    for patch, patch_name in enumerate(structure.patch_names):
        of_patch = structure.patch_of(type_name) == patch
        if of_patch.any():
            most = change[:, of_patch].max(initial=0)
            print(f"  {patch_name:<20} up to {most:8.2f} {structure.type(type_name).unit} from rest")
    if change.size:
        frame, sensor = np.unravel_index(change.argmax(), change.shape)
        position = int(np.arange(structure.n_sensors)[structure.index(type_name)][sensor])
        print(f"  most at {series.time_s[frame]:.2f} s: {structure.sensor_name(position)}")


if __name__ == "__main__":
    main(sys.argv[1])
