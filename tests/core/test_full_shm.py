"""A full /dev/shm, which any local user can fill: readers go on."""

from __future__ import annotations

import errno
import os
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin
from skinware.realtime import now_ns
from tests.cli.fake_skin import fake_structure


def publish(writer: DriverWriter, value: int) -> None:
    columns = writer.begin()
    columns["values"][:] = value
    columns["status"][:] = 0
    columns["module_time_ns"][:] = now_ns()
    writer.commit(now_ns())


def test_readers_that_cannot_announce_themselves_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", refuse)
    with DriverWriter("a", fake_structure(1, 2), rate_hz=10) as writer:
        publish(writer, 1)
        with DriverReader("a") as reader, Skin() as skin:
            for value in (1, 2, 3):
                publish(writer, value)
                assert (reader.read().values == value).all()
                assert np.all(skin.read().physical("pressure") >= 0)
