"""Types of what readers return: ``tools/test lint`` has strict mypy read this file, which runs nothing of it."""

from __future__ import annotations

import inspect
from typing import assert_type

from skinware import DriverReader, DriverSnapshot, Sample, ServiceReader


def programs_need_no_annotation() -> None:
    reader = ServiceReader("arm", timeout_s=10.0)
    assert_type(reader, ServiceReader[Sample])
    assert_type(reader.read(), Sample)
    for sample in reader.samples(rate_hz=30):
        assert_type(sample, Sample)
    assert_type(DriverReader("skin").read(), DriverSnapshot)


def read(any_reader: ServiceReader) -> Sample:
    """A reader without a parameter is one of plain samples."""
    return any_reader.read()


def test_the_package_is_typed_for_its_users() -> None:
    marker = inspect.getfile(ServiceReader).partition("service")[0] + "py.typed"
    with open(marker):  # without it, type checkers of programs take everything for Any
        pass
