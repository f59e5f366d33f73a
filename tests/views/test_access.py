"""Who may see a skin in the browser, and what is served besides."""

from __future__ import annotations

import http.client
import os
import shutil
import socket
import subprocess
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from skinware.views.access import Access, AccessRefused, account_of, is_loopback
from skinware_drivers.testing.waiting import PATIENCE_S
from tests.views.client import page_of
from tests.views.conftest import INDEX, Serve

TOKEN = "a-token"
OTHERS_PYTHON = shutil.which("python3", path="/usr/bin:/bin")
"""One that all accounts may run."""


def get(url: str, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """What a request of a browser gets."""
    where = urlsplit(url)
    connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=PATIENCE_S)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.body = response.read()  # type: ignore[attr-defined]
    connection.close()
    return response


def test_the_page_and_nothing_else(serving: Serve) -> None:
    with serving() as url:
        response = get(url)
        assert (response.status, response.body) == (200, INDEX.encode())  # type: ignore[attr-defined]
        assert response.headers["Content-Type"].startswith("text/html")
        assert "default-src 'self'" in response.headers["Content-Security-Policy"]
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        assert get(url, "/index.html?x#y").status == 200
        assert get(url, "/vendor/three.min.js").headers["Content-Type"].startswith("text/javascript")
        above = ("/secret.txt", "/../secret.txt", "/%2e%2e/secret.txt", "//etc/passwd")
        for path in (*above, "/vendor", "/vendor/", "/%00"):
            assert get(url, path).status == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[", "127.0.0.2"])
def test_a_name_that_somebody_gave_this_machine_is_refused(serving: Serve, host: str) -> None:
    with serving() as url:
        assert get(url, Host=host).status == (400 if host == "[" else 403)


def test_names_of_this_machine_are_welcome_through_any_port(serving: Serve) -> None:
    """An ssh tunnel has another port at its other end."""
    with serving() as url:
        for host in ("localhost:9999", "127.0.0.1", "[::1]:1234", "LOCALHOST"):
            assert get(url, Host=host, Origin=f"http://{host}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://localhost:1", "file://", "http://127.0.0.1"])
def test_pages_of_other_sites_are_refused(serving: Serve, origin: str) -> None:
    with serving() as url:
        with pytest.raises(InvalidStatus, match="403"), page_of(url, origin=origin):
            pass
        assert get(url, Origin=origin).status == 403
        with page_of(url, origin=url.rstrip("/")) as page:
            assert page.pull()["skin"]["drivers"] == []


@pytest.mark.skipif(os.geteuid() != 0 or OTHERS_PYTHON is None, reason="only root can be somebody else")
def test_other_accounts_need_a_token(serving: Serve) -> None:
    ask = "import sys, urllib.request as r; print(r.urlopen(sys.argv[1]).status)"
    for token, told in ((None, "HTTP Error 403"), (TOKEN, "200")):
        with serving(token=token) as url:
            command = [str(OTHERS_PYTHON), "-c", ask, url.replace("/?", "/index.html?")]
            asked = subprocess.run(command, user=12345, capture_output=True, text=True, cwd="/")
            assert told in asked.stdout + asked.stderr


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_kernel_tells_the_account(host: str) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as server:
        with socket.create_connection(server.getsockname()[:2]) as one, socket.create_connection(one.getpeername()[:2]):
            here, peer = one.getpeername()[:2], one.getsockname()[:2]
            assert account_of(peer, here) == account_of(here, peer) == os.geteuid()
        assert account_of((host, 1), here) is None


def test_a_token_is_needed_once(serving: Serve) -> None:
    with serving(token=TOKEN) as url:
        where = url.partition("?")[0]
        for path in ("/", "/?token=wrong", "/?token=", "/vendor/three.min.js", "/live"):
            assert get(where, path).status == 401
        with pytest.raises(InvalidStatus, match="401"), page_of(where):
            pass
        with page_of(url) as page:
            page.pull()
        response = get(where, f"/?token={TOKEN}")
        assert (response.status, response.headers["Location"]) == (303, "/")
        assert get(where, f"/?flat=&token={TOKEN}&x=%20").headers["Location"] == "/?flat=&x=+"
        cookie = response.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        kept = cookie.partition(";")[0]
        assert get(where, "/", Cookie=kept).status == 200
        assert get(where, "/", Cookie=f"{kept[:-1]}; other=1").status == 401
        with page_of(where, additional_headers={"Cookie": f"other=1; {kept}"}) as page:
            page.pull()
        with serving(token="another") as other:
            assert kept.partition("=")[0] not in get(other.partition("?")[0], "/?token=another").headers["Set-Cookie"]


@given(st.dictionaries(st.sampled_from(["Host", "Origin", "Cookie"]), st.text(max_size=30)), st.text(max_size=30))
def test_any_request_is_judged(headers: dict[str, str], target: str) -> None:
    for access in (Access("127.0.0.1"), Access("127.0.0.1", TOKEN), Access("0.0.0.0", TOKEN)):
        try:
            access.check(target, headers)
        except (AccessRefused, ValueError):
            continue
        assert access.token is None
        assert headers["Host"].lower().strip("[]:0123456789.") in ("", "localhost") or "@" in headers["Host"]


def test_only_this_machine_is_loopback() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "::1", "localhost", "127.1.2.3")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.2", "robot", "")))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "request_bytes",
    [
        b"GET /?token=\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /%ff%00 HTTP/1.1\r\nHost: localhost\r\nCookie: skin-view=\xff\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: \xff\r\nOrigin: \xff\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\n\r\n",
        b"GET http://[/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET  HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(100),  # TLS
        b"GET /live HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ],
)
def test_requests_that_no_browser_sends(serving: Serve, request_bytes: bytes, caplog: pytest.LogCaptureFixture) -> None:
    for token in (None, TOKEN):
        with serving(token=token) as url:
            where = urlsplit(url)
            with socket.create_connection((where.hostname or "", where.port or 0), PATIENCE_S) as connection:
                connection.sendall(request_bytes)
                answer = b"".join(iter(lambda c=connection: c.recv(4096), b""))  # type: ignore[misc]
            assert not answer.startswith((b"HTTP/1.1 2", b"HTTP/1.1 5"))
            with page_of(url) as page:
                page.pull()
    assert "Traceback" not in caplog.text
