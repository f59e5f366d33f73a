"""Say where a bridge listens and connects, who may do what there, and why no peer is reached."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import socket
import ssl
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from skinware.errors import ConfigurationError

_ALL = "skinware/**"
_OF_A_ROBOT = "skinware/*/*/*"
_QUESTIONS = [f"{_OF_A_ROBOT}/{what}" for what in ("services", "*/generation", "*/newest")]
_PINGS = [f"{_OF_A_ROBOT}/ping"]
_CALLS = [f"{_OF_A_ROBOT}/*/call/**"]

_LISTENING = ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_SPEAKING = ["put", "declare_subscriber", "delete", "reply", "declare_queryable", "liveliness_token"]
_ASKING = ["query"]


@dataclass(frozen=True)
class Rules:
    """What others may do at one that serves a robot, or routes: they see and ask; and what is told here.

    Attributes:
        callers: who may call operations; empty: all who are let in.
        routes: it speaks for no robot, but passes on what robots and their users say.
        robots: of a router: each may serve the robot of its own name, and nobody else any; empty: all may serve any.
        routers: of a router: other routers, which pass on what their own people do.
    """

    callers: Sequence[str] = ()
    routes: bool = False
    robots: Sequence[str] = ()
    routers: Sequence[str] = ()

    @property
    def names_people(self) -> bool:
        """Whether anybody is named."""
        return bool(self.callers or self.robots or self.routers)

    def text(self) -> str:
        """As zenoh has them."""
        granted = [
            _Grant("see", _LISTENING, [_ALL]),
            _Grant("ask", _ASKING, _QUESTIONS),
            _Grant("ping", ["put"], _PINGS),
            _Grant("call", _ASKING, _CALLS, self.callers),
            *(self._of_router() if self.routes else [_Grant("tell", _SPEAKING, [_ALL], flow="egress")]),
        ]
        return json.dumps(
            {
                "enabled": True,
                "default_permission": "deny",
                "rules": [grant.rule() for grant in granted],
                "subjects": [grant.subject() for grant in granted],
                "policies": [{"rules": [grant.name], "subjects": [grant.name]} for grant in granted],
            }
        )

    def _of_router(self) -> list[_Grant]:
        granted = [_Grant("pass on", [*_LISTENING, *_SPEAKING, *_ASKING], [_ALL], flow="egress")]
        for robot in self.robots:
            keys = [f"skinware/*/{robot}/**", f"skinware/live/{robot}/**"]
            granted.append(_Grant(f"serve {robot}", _SPEAKING, keys, [robot]))
        if not self.robots:
            granted.append(_Grant("serve", _SPEAKING, [_ALL]))
        if self.routers:
            granted.append(_Grant("route", [*_SPEAKING, *_ASKING], [_ALL], self.routers))
        return granted


@dataclass(frozen=True)
class _Grant:
    """Something that is allowed; what nobody allows is denied.

    Attributes:
        name: of it.
        messages: of zenoh, that may pass.
        keys: under which.
        to: names in certificates; empty: all.
        flow: ``ingress`` or ``egress``.
    """

    name: str
    messages: Sequence[str]
    keys: Sequence[str]
    to: Sequence[str] = ()
    flow: str = "ingress"

    def rule(self) -> dict[str, object]:
        return {
            "id": self.name,
            "permission": "allow",
            "flows": [self.flow],
            "messages": list(self.messages),
            "key_exprs": list(self.keys),
        }

    def subject(self) -> dict[str, object]:
        return {"id": self.name} | ({"cert_common_names": list(self.to)} if self.to else {})


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


_PATIENCE_S = 3.0


def why_unreachable(endpoint: str, tls: Path | None) -> str:
    """What a connection to an endpoint meets; waits up to some seconds.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        tls: folder with our certificates.

    Returns:
        A line for people; empty if a connection comes about.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        connection = socket.create_connection((host.strip("[]"), int(port)), _PATIENCE_S)
    except ConnectionRefusedError:
        return f"{endpoint}: nothing listens there; is skin-bridge serve running, with this --listen?"
    except TimeoutError:
        return f"{endpoint}: no answer; is the machine on, and does a firewall let this port through?"
    except OSError as error:
        return f"{endpoint}: {error.strerror or error}"
    with connection:
        return "" if tls is None else _why_no_tls(endpoint, host.strip("[]"), connection, tls)


def _why_no_tls(endpoint: str, host: str, connection: socket.socket, tls: Path) -> str:
    files = tls_files(tls)
    try:
        context = ssl.create_default_context(cafile=str(files["ca"]))
        context.load_cert_chain(files["cert"], files["key"])
        with context.wrap_socket(connection, server_hostname=host) as secured:
            secured.settimeout(_PATIENCE_S / 6)
            with contextlib.suppress(TimeoutError):  # who accepts our certificate says nothing yet
                secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint}: its certificate is not accepted here ({error.verify_message})"
    except ssl.SSLError as error:
        return f"{endpoint}: no TLS connection ({error.reason or error}); does it accept the certificate in {tls}?"
    except OSError as error:
        return f"{endpoint}: {error.strerror or error} in the TLS handshake; does it listen with --tls?"
    return ""
