"""Why nobody is reached: looked at from outside, since zenoh tries again without a word."""

from __future__ import annotations

import contextlib
import socket
import ssl
from pathlib import Path

from skinware.bridge.endpoints import tls_files

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
