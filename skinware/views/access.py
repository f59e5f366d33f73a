"""Who may see a skin in a browser: which requests are answered, judged by their account, address, token and origin.

A page of another site that somebody has open in the same browser must not see the skin: neither through a web socket
(which browsers let any page open, but with its ``Origin``), nor by giving its own name this machine's address (DNS
rebinding: the request then has that name as its ``Host``). Nor must other accounts of this machine see it: only the
group of a namespace may read that.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
from collections.abc import Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

from skinware.views.peers import account_of


class Refused(Exception):
    """A request that is not answered.

    Attributes:
        status: of the answer.
    """

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


class Access:
    """Who may.

    Args:
        host: that the server listens at.
        token: that is needed; None: this account may look, and root. Where other machines can connect, give one.
    """

    def __init__(self, host: str, token: str | None = None) -> None:
        self.token = token
        # browsers have one set of cookies for all ports of a machine
        self._cookie_name = f"skin-view-{hashlib.sha256((token or '').encode()).hexdigest()[:8]}"
        self._hosts = None if not is_loopback(host) else {"localhost", "127.0.0.1", "::1", host.lower()}

    def check(self, target: str, headers: Mapping[str, str]) -> None:
        """Make sure that a request may be answered.

        Args:
            target: path and query that are asked for.
            headers: of the request.

        Raises:
            Refused: it may not.
            ValueError: something in it cannot be an address.
        """
        host = _only(headers, "Host")
        name = urlsplit(f"http://{host}").hostname
        if not host or (self._hosts is not None and name not in self._hosts):
            raise Refused(HTTPStatus.FORBIDDEN, "this server is not called so: open the address that skin-view printed")
        origin = _only(headers, "Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            raise Refused(HTTPStatus.FORBIDDEN, "pages of other sites may not see this skin")
        if self.token is not None and not (
            self.has_token(target)
            or hmac.compare_digest(_cookie(headers, self._cookie_name).encode(), self.token.encode())
        ):
            raise Refused(HTTPStatus.UNAUTHORIZED, "open the address that skin-view printed, with its token")

    def check_account(self, peer: tuple[str, int], here: tuple[str, int]) -> None:
        """Make sure that the account at the other end of a connection may look.

        Args:
            peer: address and port of that end.
            here: those of this end.

        Raises:
            Refused: it may not.
        """
        if self.token is None and account_of(peer, here) not in (os.geteuid(), 0):
            raise Refused(HTTPStatus.FORBIDDEN, "for other accounts of this machine, skin-view needs a --token")

    def has_token(self, target: str) -> bool:
        given = parse_qs(urlsplit(target).query).get("token", [""])[0]
        return self.token is not None and hmac.compare_digest(given.encode(), self.token.encode())

    def without_token(self, target: str) -> str:
        left = [(name, value) for name, value in parse_qsl(urlsplit(target).query, True) if name != "token"]
        return f"?{urlencode(left)}" if left else ""

    @property
    def cookie(self) -> str:
        """By which a browser keeps the token, out of sight of the page."""
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
        raise Refused(HTTPStatus.BAD_REQUEST, f"more than one {name}") from None


def _cookie(headers: Mapping[str, str], name: str) -> str:
    try:
        found = SimpleCookie(_only(headers, "Cookie") or "").get(name)
    except CookieError:
        return ""
    return "" if found is None else found.value
