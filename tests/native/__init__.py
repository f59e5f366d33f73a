"""Tests of the data path in C."""
