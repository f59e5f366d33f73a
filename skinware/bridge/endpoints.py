"""Where a bridge listens and connects."""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from skinware.bridge.access import Rules
from skinware.errors import ConfigurationError

_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:.%\w]+\]|[^\s/:\[\]]+):(\d{1,5})")
DEFAULT_LISTEN, DEFAULT_ROUTER = "tcp/127.0.0.1:7448", "tcp/127.0.0.1:7447"


@dataclass(frozen=True)
class Endpoints:
    """What a session of zenoh is told.

    Attributes:
        listen: its endpoints there, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        connect: those of others.
        mode: ``peer``, which speaks with those that it is connected to; ``router``, which speaks through others, too.
        patience_us: how long a frame may wait for a receiver that is too slow before it is left out for that one.
        security: settings of zenoh.
    """

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    mode: str = "peer"
    patience_us: float = 1000.0
    security: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return " and ".join(
            f"{verb} {', '.join(places)}"
            for verb, places in (("listening at", self.listen), ("connecting to", self.connect))
            if places
        )


def endpoints(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    tls: Path | None = None,
    rules: Rules | None = None,
    insecure: bool = False,
    patience_us: float = 1000.0,
) -> Endpoints:
    """Endpoints from what a person wrote.

    Args:
        listen: where to listen.
        connect: where to connect.
        tls: folder with ``ca.pem``, ``cert.pem`` and ``key.pem``; both ends show a certificate of that authority.
        rules: what others may do; None: it only joins.
        insecure: listen beyond this machine without TLS.
        patience_us: likewise.

    Raises:
        ConfigurationError: something cannot be, or listens to strangers.
    """
    security = {} if tls is None else _tls(tls)
    protocol = None if tls is None else "tls"
    places = [_endpoint(text, protocol) for text in listen]
    if rules is not None:
        if rules.names_people and tls is None:
            raise ConfigurationError("who may do what is told by the names in certificates: give --tls, too")
        security["access_control"] = rules.text()
    for place in places:
        if place.startswith("tcp/") and not insecure and not _is_of_this_machine(place):
            raise ConfigurationError(
                f"{place} is beyond this machine, and everybody there could read the skin and call its operations:"
                " give --tls DIR, or --insecure where the network itself is trusted"
            )
    passes_on = rules is not None and (rules.routes or bool(connect))  # routers leave out peers of each other
    mode = "router" if passes_on else "peer"
    return Endpoints(places, [_endpoint(text, protocol) for text in connect], mode, patience_us, security)


def _endpoint(text: str, protocol: str | None) -> str:
    found = _ENDPOINT.fullmatch(text)
    if not found or not 0 < int(found[3]) < 65536:
        raise ConfigurationError(f"{text!r} is no endpoint: give tcp/HOST:PORT, as in tcp/192.168.1.10:7448")
    if found[1] == "tls" and protocol is None:
        raise ConfigurationError(f"{text}: give --tls DIR with the certificates")
    return f"{protocol or found[1]}/{found[2]}:{found[3]}"


def _is_of_this_machine(endpoint: str) -> bool:
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def tls_files(folder: Path) -> dict[str, Path]:
    """The files of a folder with certificates: of the authority, the own one, and its key."""
    return {name: folder / f"{name}.pem" for name in ("ca", "cert", "key")}


def _tls(folder: Path) -> dict[str, str]:
    files = tls_files(folder)
    for path in files.values():
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise ConfigurationError(
                f"{path}: {error.strerror}; docs/how-to/two-machines.md says how to make it"
            ) from None
    settings = {
        "root_ca_certificate": files["ca"],
        "listen_certificate": files["cert"],
        "listen_private_key": files["key"],
        "connect_certificate": files["cert"],
        "connect_private_key": files["key"],
    }
    told = {f"transport/link/tls/{name}": json.dumps(str(path.resolve())) for name, path in settings.items()}
    return {**told, "transport/link/tls/enable_mtls": "true"}
