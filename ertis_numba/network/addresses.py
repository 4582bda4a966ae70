"""Addresses of nodes, and their use without keys."""

import ipaddress
import re
from typing import Final

from ertis_numba.base.errors import ArgumentError

__all__ = [
    "DEFAULT_LISTEN",
    "DEFAULT_PUBLISH",
    "at_port",
    "endpoint",
    "host_of",
    "is_loopback",
    "is_own_host",
    "require_keys",
]

DEFAULT_LISTEN: Final = "tcp://127.0.0.1:5601"
"""Default address for sensor nodes."""
DEFAULT_PUBLISH: Final = "tcp://127.0.0.1:5602"
"""Default address for applications."""

_ADDRESS: Final = re.compile(r"tcp://(\*|\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9][A-Za-z0-9.-]*):(\*|[0-9]{1,5})", re.ASCII)
_HTTP_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9][A-Za-z0-9.-]*)(?::[0-9]{1,5})?", re.ASCII)


def endpoint(text: str, *, name: str = "address") -> str:
    """Return an address ``tcp://HOST:PORT`` in the form of ZeroMQ; errors use its name."""
    # A node that listens may have port 0 or `*` for a free port, and host `*` for all interfaces.
    found = _ADDRESS.fullmatch(text) if isinstance(text, str) else None
    if found is None or (found[2] != "*" and int(found[2]) > 65535):
        raise ArgumentError(f"{name} {text!r} cannot be used; use tcp://HOST:PORT, such as {DEFAULT_LISTEN}")
    if found[1].startswith("["):
        try:
            ipaddress.IPv6Address(found[1].strip("[]"))
        except ValueError as error:
            raise ArgumentError(
                f"{name} {text!r} cannot be used ({error}); use an address such as tcp://[::1]:5601"
            ) from error
    return f"tcp://{found[1]}:{'*' if found[2] == '*' else int(found[2])}"


def at_port(given: str, bound: str) -> str:
    """Return the address that a server was given, with the port that it listens at."""
    return f"{given.rpartition(':')[0]}:{bound.rpartition(':')[2]}"


def host_of(endpoint: str) -> str:
    """Return the host of an `endpoint` address, without brackets."""
    return endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")


def is_loopback(endpoint: str) -> bool:
    """Return True if other machines cannot reach an address; only literal addresses are certain."""
    host = host_of(endpoint)
    if host == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return address == ipaddress.IPv6Address("::1") or (address.version == 4 and address.is_loopback)


def is_own_host(given: str, host: str) -> bool:
    """Return True if the Host of an HTTP request, port optional, is loopback or the server's own, without brackets."""
    found = _HTTP_HOST.fullmatch(given)
    if found is None:
        return False
    bare = found[1].lower().strip("[]").removesuffix(".")
    return bare == host.lower() or is_loopback(f"tcp://[{bare}]:0" if ":" in bare else f"tcp://{bare}:0")


def require_keys(endpoint: str, *, keys: object | None) -> None:
    """Refuse an address that other machines can reach if there are no keys."""
    if keys is None and not is_loopback(endpoint):
        raise ArgumentError(
            f"address {endpoint} can be reached from other machines, but there are no keys; create keys with "
            "'ertis keys new' and use them (keys), or use tcp://127.0.0.1:PORT"
        )
