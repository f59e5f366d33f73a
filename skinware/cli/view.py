"""``skin-view``: show a skin in the browser."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import ipaddress
import os
import re
import secrets
import socket
import ssl
import sys
import threading
import webbrowser
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlencode

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, say
from skinware.errors import ConfigurationError, MissingExtra

if TYPE_CHECKING:
    from skinware.views.access import Access
    from skinware.views.following import Follower
    from skinware.views.shows import RecordingFiles

DEFAULT_PORT = 8736
_TOKEN = re.compile(r"[A-Za-z0-9_.~-]+")


def token_text(text: str) -> str:
    """Return a token that needs no quoting in an address; for ``click.option(type=...)``."""
    if not _TOKEN.fullmatch(text):
        raise click.BadParameter("give letters, digits, '_', '.', '~' or '-'.")
    return text


@cli.command(
    "skin-view",
    "skin-view                       all drivers, in the browser",
    "skin-view torso --no-browser    one driver; prints the address to open",
    "skin-view walk.mcap             a recording; two files: beside each other",
    "skin-view --links robot.urdf    on the meshes of a robot",
    "skin-view --host 0.0.0.0        for other machines too; the address contains a token",
)
@click.argument("names", metavar="[NAME|FILE]...", nargs=-1)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help=f"Port to listen at; 0: any that is free.  [default: {DEFAULT_PORT}, or any if that is in use]",
)
@click.option("--host", default="127.0.0.1", help="Address to listen at.")
@click.option(
    "--token",
    metavar="TEXT",
    type=token_text,
    help="Token that the address needs.  [default: a random one, if other machines can connect]",
)
@cli.tls_option("Serve https; DIR has cert.pem and key.pem.")
@click.option(
    "--calm",
    "calm_name",
    metavar="NAMESPACE",
    help="Namespace of calmed drivers and their contacts.  [default: that of skin-calm]",
)
@cli.links_option("Links of the robot: places of coordinate frames, and meshes; TOML or URDF.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
@cli.namespace_option
@cli.json_option
def command(
    names: tuple[str, ...],
    port: int | None,
    host: str,
    token: str | None,
    tls: Path | None,
    calm_name: str | None,
    links: Path | None,
    no_browser: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Show drivers NAME..., or all of them, live in a browser, or recordings FILE....

    Where skin-calm runs, changes from its baselines, contacts and regions are shown too.

    Exit status: 0 ended or interrupted, 1 failed, 2 wrong usage.
    """
    if find_spec("websockets") is None:
        raise MissingExtra.of("views", "skinware[view]")
    import skinware.recording
    from skinware.memory.namespace import Namespace, check_name
    from skinware.views.access import Access, is_loopback
    from skinware.views.following import Follower, Origin
    from skinware.views.robot import read_robot
    from skinware.views.shows import SUFFIX, RecordingFiles

    files = [Path(name) for name in names if name.endswith(SUFFIX) or "/" in name]
    names = tuple(name for name in names if Path(name) not in files)
    for file in files:
        with skinware.recording.open(file) as recording:
            for problem in recording.problems:
                cli.warn(f"{file}: {problem}")
    for name in names:
        check_name(name, "driver")
    place = Namespace(namespace)
    calm_name = calm_name or place.calm_name
    calm = None if place.name == calm_name else Namespace(calm_name)
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(16)
    robot = None if links is None else read_robot(links)
    for what in () if robot is None else robot.left_out:
        cli.warn(f"left out of {links}: {what}")
    follower = Follower(Origin(place, names, calm), robot=robot)
    access, context = Access(host, token), None if tls is None else tls_context(tls)

    def ready(found: int) -> None:
        query = [("token", token)] * bool(token) + [("recording", str(file)) for file in files]
        scheme, asked = "https" if context else "http", f"?{urlencode(query, safe='/')}" if query else ""
        urls = [f"{scheme}://{f'[{at}]' if ':' in at else at}:{found}/{asked}" for at in addresses(host)]
        url = urls[0]
        what = ", ".join(map(str, [*files, *names])) or f"all drivers of namespace {place.name!r}"
        ready = {"event": "ready", "url": url, "urls": urls, "namespace": place.name, "names": list(names)}
        say(as_json, ready, "\n".join([f"{url} shows {what} (Ctrl-C ends)", *urls[1:]]))
        if not as_json and not is_loopback(host):
            echo(qr_text(urls[0]))
        has_screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")  # not a text browser in here
        if not no_browser and has_screen:
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

    runner, stop = asyncio.Runner(), asyncio.Event()
    loop = runner.get_loop()

    def end() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(stop.set)

    try:
        with cli.signals_end(end), contextlib.closing(follower), runner:
            runner.run(_serve(follower, access, RecordingFiles(files, names=names), context, host, port, stop, ready))
    except OSError as error:
        why = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error.strerror or error)
        if error.errno == errno.EADDRINUSE:
            why = "in use: give another --port, or 0 for any that is free"
        echo(f"skin-view: {host}, port {DEFAULT_PORT if port is None else port}: {why}", err=True)
        click.get_current_context().exit(cli.EXIT_FAILED)


async def _serve(
    follower: Follower,
    access: Access,
    files: RecordingFiles,
    tls: ssl.SSLContext | None,
    host: str,
    port: int | None,
    stop: asyncio.Event,
    ready: Callable[[int], None],
) -> None:
    from skinware.views.programs import RECORD, DoctorProgram, RecordingProgram
    from skinware.views.server import ViewServer

    (origin,) = follower.origins
    namespace = origin.namespace.name
    doctor = DoctorProgram((sys.executable, "-m", "skinware_drivers.cli.doctor"), namespace)
    recording = RecordingProgram(RECORD, namespace, origin.names)
    server = ViewServer(follower, access, recording, doctor=doctor, files=files, tls=tls)
    try:
        await server.show(host, DEFAULT_PORT if port is None else port, ready, stop)
    except OSError as error:
        if port is not None or error.errno != errno.EADDRINUSE:
            raise
        await server.show(host, 0, ready, stop)


def addresses(host: str) -> list[str]:
    """Return the names and addresses at which other machines, or this one, reach a server that listens at ``host``."""
    if host not in ("0.0.0.0", "::"):
        return [host]
    family = socket.AF_INET if host == "0.0.0.0" else socket.AF_UNSPEC
    name, found = socket.gethostname(), []
    with contextlib.suppress(OSError):
        found = [str(info[4][0]) for info in socket.getaddrinfo(name, None, family, socket.SOCK_STREAM)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out, contextlib.suppress(OSError):
        out.connect(("192.0.2.1", 9))  # nothing is sent: the kernel chooses the address towards other networks
        found.insert(0, out.getsockname()[0])
    outside = [at for at in dict.fromkeys(found) if not ipaddress.ip_address(at.partition("%")[0]).is_loopback]
    return [*(at for at in outside if "%" not in at), name]


def qr_text(url: str) -> str:
    """Return an address as a QR code of characters; without the package for it, how to install that."""
    if find_spec("segno") is None:
        return "for a QR code of it: pip install segno"
    import segno

    out = io.StringIO()
    segno.make(url, error="l").terminal(out, compact=True)
    return out.getvalue()


def tls_context(folder: Path) -> ssl.SSLContext:
    """Return what a server of https needs, from ``cert.pem`` and ``key.pem`` in a folder; refuse any other."""
    certificate, key = folder / "cert.pem", folder / "key.pem"
    for file in (certificate, key):
        if not file.is_file():
            raise ConfigurationError(f"--tls: {file} is missing; the folder needs cert.pem and key.pem")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        why = "they do not belong together" if error.reason == "KEY_VALUES_MISMATCH" else error.reason or str(error)
        raise ConfigurationError(f"--tls: {certificate} and {key}: {why}") from None
    except OSError as error:
        raise ConfigurationError(f"--tls: {error.filename or folder}: {error.strerror or error}") from None
    why = _refused(context, certificate)
    if why:
        raise ConfigurationError(f"--tls: {certificate}: {why}, and browsers would refuse it")
    return context


def _refused(server: ssl.SSLContext, certificate: Path) -> str:
    """Return why a client that trusts a certificate would refuse it now; empty if it would not."""
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    client.load_verify_locations(certificate)
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)
    try:
        for end in 2 * ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message
    return ""


main = partial(cli.run, command, goes_on=True)
