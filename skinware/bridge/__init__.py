"""A namespace on another machine: served there, joined here, over zenoh."""

from __future__ import annotations

from importlib.util import find_spec

from skinware.errors import MissingExtra

if find_spec("zenoh") is None:
    raise MissingExtra.of("bridges", "skinware[zenoh]")

from skinware.bridge.endpoints import DEFAULT_LISTEN, DEFAULT_ROUTER, Endpoints, Rules, endpoints
from skinware.bridge.joining import Joiner
from skinware.bridge.link import Link
from skinware.bridge.messages import Wish
from skinware.bridge.serving import Server
from skinware.bridge.watching import Watcher

__all__ = [
    "DEFAULT_LISTEN",
    "DEFAULT_ROUTER",
    "Endpoints",
    "Joiner",
    "Link",
    "Rules",
    "Server",
    "Watcher",
    "Wish",
    "endpoints",
]
