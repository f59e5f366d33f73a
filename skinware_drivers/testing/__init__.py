"""Tests for drivers: a conformance suite, fixtures (see ``plugin``), and the lab. The only part that imports pytest."""
