"""Make learning sets of recordings: episodes at a fixed rate, with skin values, status, age, joints and cameras.

:func:`skinware.conversion.learning.export.convert_to_learning_set` reads recordings twice: once for the times of their
samples, from which it plans all rows (:mod:`timing`), and once for their contents, a few rows at a time.
"""

from __future__ import annotations

from skinware.conversion.learning.export import LEARNING_FORMATS, convert_to_learning_set
from skinware.conversion.learning.wanted import Interval, Join, LearningSet, interval_of, join_of, read_intervals

__all__ = [
    "LEARNING_FORMATS",
    "Interval",
    "Join",
    "LearningSet",
    "convert_to_learning_set",
    "interval_of",
    "join_of",
    "read_intervals",
]
