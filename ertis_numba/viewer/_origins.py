"""Protection of the page: it serves browsers that opened it here, not pages of other sites in the same browser."""

import contextlib
import hmac
import http
import http.cookies
import urllib.parse
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import websockets.asyncio.server

from ertis_numba.network import addresses

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

__all__ = ["is_loopback", "own_pages"]

_PORTS = {"http": 80, "https": 443}
_COOKIE = "ertis_view"  # The name also contains the port, because cookies do not distinguish the ports of a host.
_REFUSAL = "Open the address that 'ertis view' printed, with its token.\n"


def is_loopback(host: str) -> bool:
    """Return True if a host, in any spelling, cannot be reached from another machine."""
    bare = host.lower().strip("[]")
    return addresses.is_loopback(f"tcp://[{bare}]:0" if ":" in bare else f"tcp://{bare}:0")


@contextlib.contextmanager
def own_pages(host: str, token: str | None = None) -> Iterator[None]:
    """Make a server created in this block refuse pages of other sites, which a browser lets connect to any host."""
    # A page from here has the same site (Origin, RFC 6454) and server (Host), on loopback by a loopback name. With a
    # token, it also refuses browsers without `?token=` or its cookie. viser accepts all of them, and has no option.
    serve = websockets.asyncio.server.serve
    local = is_loopback(host)

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def refuse_others(connection: "ServerConnection", request: "Request") -> "Response | None":
            origins, hosts = (request.headers.get_all(name) for name in ("Origin", "Host"))
            if not _is_own(origins, hosts, local=local):
                return connection.respond(
                    http.HTTPStatus.FORBIDDEN, "This page requires the address printed by 'ertis view'.\n"
                )
            given = None if token is None else _token_of(request)
            if token is not None and not hmac.compare_digest(given or "", token):
                return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)
            answer: Response | None = process_request(connection, request)
            if token is not None and answer is not None:
                name = _cookie_of(request)
                answer.headers["Set-Cookie"] = f"{name}={token}; HttpOnly; SameSite=Strict; Path=/"
                answer.headers["Referrer-Policy"] = "no-referrer"  # The address contains the token.
            return answer

        return serve(*arguments, process_request=refuse_others, **options)

    setattr(websockets.asyncio.server, "serve", guarded)  # noqa: B010  mypy would not have a class replaced
    try:
        yield
    finally:
        setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010  as above


def _token_of(request: "Request") -> str | None:
    """Return the token that a browser sends, first in the address and later in a cookie."""
    query = urllib.parse.parse_qs(urllib.parse.urlsplit(request.path).query)
    if "token" in query:
        return query["token"][-1].encode("ascii", "replace").decode()
    cookies: http.cookies.SimpleCookie = http.cookies.SimpleCookie()
    with contextlib.suppress(http.cookies.CookieError):
        for header in request.headers.get_all("Cookie"):
            cookies.load(header)
    kept = cookies.get(_cookie_of(request))
    return None if kept is None else kept.value.encode("ascii", "replace").decode()


def _cookie_of(request: "Request") -> str:
    host = request.headers.get_all("Host")[:1] or [""]
    port = host[0].rpartition(":")[2]
    return f"{_COOKIE}_{port}" if port.isdigit() else _COOKIE


def _is_own(origins: list[str], hosts: list[str], *, local: bool) -> bool:
    """Return True if a request comes from a page of this server, or from a program, which has no origin."""
    if not origins:
        return True
    if len(origins) > 1 or len(hosts) != 1:
        return False
    try:
        origin = urllib.parse.urlsplit(origins[0])
        here = urllib.parse.urlsplit(f"{origin.scheme}://{hosts[0]}")
        default = _PORTS.get(origin.scheme)
        same = (origin.hostname, origin.port or default) == (here.hostname, here.port or default)
    except ValueError:  # No port, or an invalid address.
        return False
    return default is not None and origin.hostname is not None and same and (not local or is_loopback(origin.hostname))
