"""Tests of the data path in C."""

import pytest

from skinware_drivers.testing.both_paths import why_python

needs_native = pytest.mark.skipif(bool(why_python()), reason=f"no data path in C: {why_python()}")
