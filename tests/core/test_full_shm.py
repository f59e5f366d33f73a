"""A full /dev/shm, which any local user can fill: readers go on."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
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

    with DriverWriter("a", fake_structure(1, 2), rate_hz=10) as writer:
        monkeypatch.setattr(os, "pwrite", refuse)
        publish(writer, 1)
        with DriverReader("a") as reader, Skin() as skin:
            for value in (1, 2, 3):
                publish(writer, value)
                assert (reader.read().values == value).all()
                assert np.all(skin.read().physical("pressure") >= 0)


FULL = """
import contextlib, os, threading
from skinware import DriverReader, DriverWriter, ServiceReader, ServiceWriter, Skin
from skinware.errors import NamespaceError
from tests.cli.fake_skin import fake_structure
from tests.core.test_full_shm import publish

writer = DriverWriter("a", fake_structure(1, 2), rate_hz=10)
service = ServiceWriter("b", {"v": ("<u1", 8)}, operations={"ping": lambda: "pong"})
service.request_server()
publish(writer, 1)
service.begin()
service.commit(1)
old = DriverReader("a")
assert (old.read().values == 1).all()
with open("/dev/shm/filling", "wb", buffering=0) as file:
    for size in (1 << 16, 1 << 12):
        with contextlib.suppress(OSError):
            while True:
                file.write(bytes(size))
new, skin = DriverReader("a"), Skin()
for value in (2, 3, 4):
    publish(writer, value)
    assert (old.read().values == value).all()
    assert (new.read().values == value).all()
    assert (skin.read().samples[0].values == value).all()
assert (next(DriverReader("a").in_order()).values == 4).all()

served = threading.Event()

def serve():
    while not served.is_set():
        service.answer_requests(0.01)

thread = threading.Thread(target=serve, daemon=True)
thread.start()
assert ServiceReader("b").call("ping") == "pong"
served.set()
thread.join()
for attempt in (
    lambda: ServiceWriter("c", {"v": ("<u1", 1 << 16)}),
    lambda: service.restructure({"v": ("<u1", 1 << 16)}),
):
    try:
        attempt()
    except NamespaceError as error:
        assert "No space left" in str(error), error
    else:
        raise AssertionError("there was room")
service.begin()
service.commit(2)
os.unlink("/dev/shm/filling")
ServiceWriter("c", {"v": ("<u1", 1 << 16)}).close()
assert service.restructure({"v": ("<u1", 1 << 16)}) is None
publish(writer, 5)
assert (new.read().values == 5).all()
print("went on")
"""


@pytest.mark.thorough
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, for a /dev/shm of its own")
def test_a_really_full_shm_stops_neither_readers_nor_requests() -> None:
    """In a mount namespace of its own, whose /dev/shm has 3 MB."""
    mount = "mount --make-rprivate / && mount -t tmpfs -o size=3m tmpfs /dev/shm"
    script = f'{mount} && exec "{sys.executable}" -c "$0"'
    done = subprocess.run(["unshare", "-m", "sh", "-c", script, FULL], capture_output=True, text=True, timeout=110)
    if any(line.startswith(("unshare:", "mount:")) for line in done.stderr.splitlines()):
        pytest.skip(done.stderr)
    assert done.stdout == "went on\n", done.stderr
