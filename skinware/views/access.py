"""Decide who may see a skin in a browser: by account, address, token and origin."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import sys
from collections.abc import Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

_TABLES = {4: Path("/proc/net/tcp"), 6: Path("/proc/net/tcp6")}
_LOCAL, _REMOTE, _UID = 1, 2, 7
"""Columns of the tables."""
_WORD = 4


def account_of(peer: tuple[str, int], here: tuple[str, int]) -> int | None:
    """Return the user id of the owner of ``peer``, an end on this machine; None where the kernel does not show it."""
    local, remote = _in_table(peer), _in_table(here)
    try:
        lines = _TABLES[ipaddress.ip_address(peer[0]).version].read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        columns = line.split()
        if columns[_LOCAL] == local and columns[_REMOTE] == remote:
            return int(columns[_UID])
    return None


def _in_table(end: tuple[str, int]) -> str:
    """Return an end as the tables write it: words of the address in the byte order of the machine, and the port."""
    address = ipaddress.ip_address(end[0]).packed
    words = [int.from_bytes(address[at : at + _WORD], sys.byteorder) for at in range(0, len(address), _WORD)]
    return "".join(f"{word:08X}" for word in words) + f":{end[1]:04X}"


class AccessRefused(Exception):
    """A request is refused, with this status of the answer."""

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


class Access:
    """Decide which requests may be answered; without a token, this account and root may look."""

    def __init__(self, host: str, token: str | None = None) -> None:
        self.token = token
        # browsers have one set of cookies for all ports of a machine
        self._cookie_name = f"skin-view-{hashlib.sha256((token or '').encode()).hexdigest()[:8]}"
        self._hosts = None if not is_loopback(host) else {"localhost", "127.0.0.1", "::1", host.lower()}

    def check(self, target: str, headers: Mapping[str, str]) -> None:
        """Check that a request may be answered; ValueError: something in it cannot be an address."""
        host = _only(headers, "Host")
        name = urlsplit(f"http://{host}").hostname
        if not host or (self._hosts is not None and name not in self._hosts):
            raise AccessRefused(
                HTTPStatus.FORBIDDEN, "this server has another name: open the address that skin-view printed"
            )
        origin = _only(headers, "Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            raise AccessRefused(HTTPStatus.FORBIDDEN, "pages of other sites may not see this skin")
        if self.token is not None and not (
            self.has_token(target)
            or hmac.compare_digest(_cookie(headers, self._cookie_name).encode(), self.token.encode())
        ):
            raise AccessRefused(HTTPStatus.UNAUTHORIZED, "open the address that skin-view printed, with its token")

    def check_account(self, peer: tuple[str, int], here: tuple[str, int]) -> None:
        """Check that the account at the other end of a connection may look."""
        if self.token is None and account_of(peer, here) not in (os.geteuid(), 0):
            raise AccessRefused(HTTPStatus.FORBIDDEN, "for other accounts of this machine, skin-view needs a --token")

    def has_token(self, target: str) -> bool:
        given = parse_qs(urlsplit(target).query).get("token", [""])[0]
        return self.token is not None and hmac.compare_digest(given.encode(), self.token.encode())

    def without_token(self, target: str) -> str:
        left = [(name, value) for name, value in parse_qsl(urlsplit(target).query, True) if name != "token"]
        return f"?{urlencode(left)}" if left else ""

    @property
    def cookie(self) -> str:
        """The cookie in which a browser keeps the token, out of sight of the page."""
        return f"{self._cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _only(headers: Mapping[str, str], name: str) -> str | None:
    try:
        return headers.get(name)
    except LookupError:
        raise AccessRefused(HTTPStatus.BAD_REQUEST, f"more than one {name}") from None


def _cookie(headers: Mapping[str, str], name: str) -> str:
    try:
        found = SimpleCookie(_only(headers, "Cookie") or "").get(name)
    except CookieError:
        return ""
    return "" if found is None else found.value
