"""Options shared by the network commands."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.network.keys import ClientKeys, ServerKeys
    from ertis_numba.network.metrics import Metrics
    from ertis_numba.network.status import Status

__all__ = [
    "allow",
    "client_keys",
    "key",
    "key_file",
    "metrics",
    "require_address",
    "require_duration",
    "server_key",
    "server_keys",
]

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

key: Decorator = click.option(
    "--key", metavar="FILE|NAME", help="Secret key of this node: a .secret.toml from 'ertis keys new', or its name."
)
server_key: Decorator = click.option(
    "--server-key",
    metavar="FILE|NAME|KEY",
    help="Public key of the central node; a node with another key is refused.",
)
allow: Decorator = click.option(
    "--allow",
    type=options.FILE,
    metavar="FILE",
    help="List of allowed keys; the list of 'ertis keys allow' by default.",
)


def server_keys(key: str | None, allow: Path | None) -> "ServerKeys | None":
    """Return the keys of a central node, or None if no keys were given."""
    from ertis_numba.network.allow_list import ALLOW_LIST
    from ertis_numba.network.keys import KeyPair, ServerKeys, default_folder

    if key is None:
        if allow is not None:
            raise click.UsageError("--allow has no effect without --key; add --key")
        return None
    return ServerKeys(KeyPair.load(key_file(key, "secret")), allow or default_folder() / ALLOW_LIST)


def client_keys(key: str | None, server_key: str | None) -> "ClientKeys | None":
    """Return the keys of a sensor node or an application, or None if no keys were given."""
    from ertis_numba.base.errors import SettingsError
    from ertis_numba.network.keys import ClientKeys, KeyPair, public_key

    if key is None and server_key is None:
        return None
    if key is None or server_key is None:
        given, other = ("--server-key", "--key") if key is None else ("--key", "--server-key")
        raise click.UsageError(
            f"{given} is given without {other}; use both, or neither for a central node on this machine"
        )
    pair = KeyPair.load(key_file(key, "secret"))
    try:
        return ClientKeys(pair, public_key(key_file(server_key, "public"))[0])
    except SettingsError as error:
        raise SettingsError(f"--server-key: {error}") from error


def metrics(given: str | None, latest: "Callable[[], Status]") -> "Metrics | None":
    """Return a metrics server that has not started, or None without an address."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.network.addresses import endpoint
    from ertis_numba.network.metrics import Metrics

    if given is None:
        return None
    try:
        endpoint(f"tcp://{given}")
    except ArgumentError as error:
        raise ArgumentError(f"--metrics is {given!r}; use HOST:PORT, such as 127.0.0.1:9101") from error
    return Metrics(given, latest)


def require_address(option: str, given: str | None) -> None:
    """Raise ArgumentError if the text of an option is not an address, before anything is opened."""
    from ertis_numba.network.addresses import endpoint

    if given is not None:
        endpoint(given, name=option)


def require_duration(given: float | None) -> None:
    """Raise ArgumentError if a duration is not above zero, before anything is opened."""
    from ertis_numba.base import checks

    if given is not None:
        checks.positive("--duration", given)


def key_file(given: str, kind: str) -> str:
    """Return a file of the key folder that was given by its name or its key's; return any other text unchanged."""
    from ertis_numba.network.keys import default_folder

    if Path(given).name != given or Path(given).is_file():
        return given
    names = (given, f"{given}.{kind}.toml") if given else ()
    return next((str(file) for name in names if (file := default_folder() / name).is_file()), given)
