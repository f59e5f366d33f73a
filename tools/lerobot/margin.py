"""Requires that the policies of examples/learning/grip.py hold more objects with touch than without."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

MARGIN = 0.5
"""Between the worst policy with touch and the best one without."""


def main() -> None:
    curves = json.loads(Path(sys.argv[1], "curves.json").read_text())
    least, most = np.min([each[-1] for each in curves["with touch"]]), np.max([each[-1] for each in curves["without"]])
    print(f"grips held: {least:.0%} or more with touch, {most:.0%} or less without")
    assert least >= most + MARGIN


if __name__ == "__main__":
    main()
