"""A zenoh router as ``rmw_zenohd`` is one, in a process of its own: can be killed, and started again at its place."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from tests.streams.peers import free_port


class Router:
    """One that runs.

    Attributes:
        port: where it listens, on this machine only.
        endpoint: the same, as zenoh has it.
    """

    def __init__(self) -> None:
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Have it run; returns when it listens."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, self.endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def kill(self) -> None:
        """End it without a word to anybody. Idempotent."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@contextmanager
def router() -> Iterator[Router]:
    """One at a place of its own."""
    one = Router()
    one.start()
    try:
        yield one
    finally:
        one.kill()


def sockets() -> set[str]:
    """Of this process: zenoh closes those of a session a little after it, in its own threads."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):
            found.add(os.readlink(f"/proc/self/fd/{number}"))
    return {target for target in found if target.startswith("socket:")}


def settings(**more: object) -> zenoh.Config:
    """Of a session as rmw_zenoh opens it: no multicast; peers hear of each other from routers."""
    config = zenoh.Config()
    told = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
    }
    for path, value in {**told, **more}.items():
        config.insert_json5(path, json.dumps(value))
    return config


def main() -> None:
    with zenoh.open(settings(**{"mode": "router", "listen/endpoints": [sys.argv[1]]})):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
