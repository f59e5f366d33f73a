"""These tests run with any library: see ``sanitizing``."""

from tests.native.sanitizing import use_library

use_library()
