"""Where a bridge listens and connects, who may do what there, and why a peer cannot be reached."""

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

DEFAULT_LISTEN, DEFAULT_ROUTER = "tcp/127.0.0.1:7448", "tcp/127.0.0.1:7447"
_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:.%\w]+\]|[^\s/:\[\]]+):(\d{1,5})")
_CONNECT_S, _TLS_ERROR_S = 3.0, 0.5

_ALL = ("skinware/**",)
_QUESTIONS = tuple(f"skinware/*/*/*/{key}" for key in ("services", "*/generation", "*/newest"))
_SUBSCRIBE = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
_PUBLISH = ("put", "declare_subscriber", "delete", "reply", "declare_queryable", "liveliness_token")
_ASK = ("query",)


@dataclass(frozen=True)
class Rules:
    """Rights of peers at a bridge that serves a robot, or at a router. All may subscribe and ask.

    Attributes:
        callers: names of the certificates that may call operations; empty: all.
        routes: the bridge serves no robot, but passes messages between robots and their users.
        robots: at a router: each may serve only the robot that has the name of its certificate; empty: all may serve.
        routers: at a router: names of other routers, which pass on messages of their own peers.
    """

    callers: Sequence[str] = ()
    routes: bool = False
    robots: Sequence[str] = ()
    routers: Sequence[str] = ()

    def access_control(self) -> str:
        """Return zenoh's setting of that name, JSON; it denies all that no rule permits."""
        rules: list[dict[str, object]] = []
        subjects: list[dict[str, object]] = []

        def permit(
            name: str,
            messages: Sequence[str],
            keys: Sequence[str],
            certificates: Sequence[str] = (),
            flow: str = "ingress",
        ) -> None:
            """Let messages pass under some keys, for the named certificates or, if there are none, for all."""
            what = {"messages": list(messages), "key_exprs": list(keys)}
            rules.append({"id": name, "permission": "allow", "flows": [flow], **what})
            subjects.append({"id": name} | ({"cert_common_names": list(certificates)} if certificates else {}))

        permit("see", _SUBSCRIBE, _ALL)
        permit("ask", _ASK, _QUESTIONS)
        permit("ping", ("put",), ("skinware/*/*/*/ping",))
        permit("call", _ASK, ("skinware/*/*/*/*/call/**",), self.callers)
        if self.routes:
            permit("pass on", (*_SUBSCRIBE, *_PUBLISH, *_ASK), _ALL, flow="egress")
            for robot in self.robots:
                permit(f"serve {robot}", _PUBLISH, (f"skinware/*/{robot}/**", f"skinware/live/{robot}/**"), [robot])
            if not self.robots:
                permit("serve", _PUBLISH, _ALL)
            if self.routers:
                permit("route", (*_PUBLISH, *_ASK), _ALL, self.routers)
        else:
            permit("publish", _PUBLISH, _ALL, flow="egress")
        policies = [{"rules": [rule["id"]], "subjects": [rule["id"]]} for rule in rules]
        known = {"rules": rules, "subjects": subjects, "policies": policies}
        return json.dumps({"enabled": True, "default_permission": "deny", **known})


@dataclass(frozen=True)
class Endpoints:
    """Settings of a session of zenoh.

    Attributes:
        listen: own endpoints, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        connect: endpoints of others.
        mode: ``peer`` for a session that speaks with those that it is connected to; ``router`` for one that also
            passes messages on.
        security: further settings of zenoh, by path.
    """

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    mode: str = "peer"
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
) -> Endpoints:
    """Check what a person wrote, and return the settings.

    Args:
        tls: folder with ``ca.pem``, ``cert.pem`` and ``key.pem``; both ends show a certificate of that authority.
        rules: rights of peers; None: this end only joins.
        insecure: listen beyond this machine without TLS.

    Raises:
        ConfigurationError: an endpoint or certificate is missing or wrong, or an endpoint is open to strangers.
    """
    security = {} if tls is None else _tls_settings(tls)
    protocol = None if tls is None else "tls"
    places = [_checked(text, protocol) for text in listen]
    if rules is not None:
        if tls is None and (rules.callers or rules.robots or rules.routers):
            raise ConfigurationError("rights are given to the names in certificates: give --tls, too")
        security["access_control"] = rules.access_control()
    for place in places:
        if place.startswith("tcp/") and not insecure and not _is_on_this_machine(place):
            raise ConfigurationError(
                f"{place} can be reached from other machines, and everybody there could read the skin and call its"
                " operations: give --tls DIR, or --insecure where the network itself is trusted"
            )
    passes_on = rules is not None and (rules.routes or bool(connect))  # routers leave out peers of each other
    mode = "router" if passes_on else "peer"
    return Endpoints(places, [_checked(text, protocol) for text in connect], mode, security)


def split_endpoint(text: str, least_port: int = 1) -> tuple[str, str, int]:
    """Return protocol, host and port of ``tcp/HOST:PORT`` or ``tls/HOST:PORT``; ConfigurationError: it is neither."""
    found = _ENDPOINT.fullmatch(text)
    if not found or not least_port <= int(found[3]) < 65536:
        raise ConfigurationError(f"{text!r} is no endpoint: give tcp/HOST:PORT, as in tcp/192.168.1.10:7448")
    return found[1], found[2].strip("[]"), int(found[3])


def _checked(text: str, protocol: str | None) -> str:
    own = split_endpoint(text)[0]
    if own == "tls" and protocol is None:
        raise ConfigurationError(f"{text}: give --tls DIR with the certificates")
    return f"{protocol or own}/{text.partition('/')[2]}"


def _is_on_this_machine(endpoint: str) -> bool:
    host = split_endpoint(endpoint)[1]
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _tls_settings(folder: Path) -> dict[str, str]:
    ca, cert, key = (folder / f"{name}.pem" for name in ("ca", "cert", "key"))
    for path in (ca, cert, key):
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise ConfigurationError(
                f"{path}: {error.strerror}; docs/how-to/two-machines.md says how to make it"
            ) from None
    settings = {
        "root_ca_certificate": ca,
        "listen_certificate": cert,
        "listen_private_key": key,
        "connect_certificate": cert,
        "connect_private_key": key,
    }
    paths = {f"transport/link/tls/{name}": json.dumps(str(path.resolve())) for name, path in settings.items()}
    return {**paths, "transport/link/tls/enable_mtls": "true"}


def why_unreachable(endpoint: str, tls: Path | None) -> str:
    """Try to connect to an endpoint; this can take some seconds.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.

    Returns:
        The reason why it fails, in one line; empty if it succeeds.
    """
    _, host, port = split_endpoint(endpoint)
    try:
        connection = socket.create_connection((host, port), _CONNECT_S)
    except ConnectionRefusedError:
        return f"{endpoint}: nothing listens there; is skin-bridge serve running, with this --listen?"
    except TimeoutError:
        return f"{endpoint}: no answer; is the machine on, and does a firewall let this port through?"
    except OSError as error:
        return f"{endpoint}: {error.strerror or error}"
    with connection:
        return "" if tls is None else _why_no_tls(endpoint, host, connection, tls)


def _why_no_tls(endpoint: str, host: str, connection: socket.socket, tls: Path) -> str:
    try:
        context = ssl.create_default_context(cafile=str(tls / "ca.pem"))
        context.load_cert_chain(tls / "cert.pem", tls / "key.pem")
        with context.wrap_socket(connection, server_hostname=host) as secured:
            secured.settimeout(_TLS_ERROR_S)
            with contextlib.suppress(TimeoutError):  # a peer that accepts our certificate sends nothing yet
                secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint}: its certificate is not accepted here ({error.verify_message})"
    except ssl.SSLError as error:
        return f"{endpoint}: no TLS connection ({error.reason or error}); does it accept the certificate in {tls}?"
    except OSError as error:
        return f"{endpoint}: {error.strerror or error} in the TLS handshake; does it listen with --tls?"
    return ""
