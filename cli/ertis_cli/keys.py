"""``ertis keys``: keys of nodes, and the list of allowed keys."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _network, options

if TYPE_CHECKING:
    from ertis_numba.network.allow_list import Permission

__all__ = ["keys"]

_list_file = click.option(
    "--list",
    "listed",
    type=options.FILE,
    metavar="FILE",
    help="List of allowed keys; allow.toml beside the keys by default.",
)


@click.group()
def keys() -> None:
    """Create keys and manage the list of allowed keys.

    Create keys on each machine with 'ertis keys new'. Copy the public file of a machine to the central node, and add it
    to the list with 'ertis keys allow'. Copy the public file of the central node to each machine (--server-key).

    \b
    central$  ertis keys new central
    sensor$   ertis keys new robot
    central$  ertis keys allow robot.public.toml --role sensor --serial front
    central$  ertis record --listen tcp://0.0.0.0:5601 -o DIR --key central
    sensor$   ertis capture --port front --to tcp://central:5601 --key robot --server-key central.public.toml
    """


@keys.command()
@click.argument("name")
@click.option(
    "--dir",
    "folder",
    type=options.FOLDER,
    metavar="DIR",
    help="Folder for the key files; the key folder of this user by default.",
)
@options.as_json
def new(*, name: str, folder: Path | None, as_json: bool) -> None:
    """Create a key pair: NAME.secret.toml, to keep, and NAME.public.toml, to give to others."""
    from ertis_numba.network.keys import KeyPair, default_folder

    pair = KeyPair.new(name)
    secret, public = pair.save(folder or default_folder())
    if as_json:
        options.print_json(
            {"name": name, "public": pair.public, "secret_file": str(secret), "public_file": str(public)}
        )
        return
    click.echo(f"{secret}: secret key; keep it, and let nobody else read it")
    click.echo(f"{public}: public key for the other side, {pair.public}")


@keys.command()
@click.argument("key", metavar="PUBLIC_FILE|NAME|KEY")
@click.option(
    "--role",
    required=True,
    type=click.Choice(["sensor", "application", "admin"]),
    help="A sensor may send, an application may receive, and an admin may do both.",
)
@click.option(
    "--serial", "serials", multiple=True, metavar="S", help="Name of a sensor that the key may send for; repeatable."
)
@click.option("--name", metavar="NAME", help="Name in the list; the name in the file by default.")
@_list_file
@options.as_json
def allow(
    *, key: str, role: str, serials: tuple[str, ...], name: str | None, listed: Path | None, as_json: bool
) -> None:
    """Allow a key within a second; earlier permissions of the key are replaced.

    PUBLIC_FILE is searched for here, and then in the key folder of this user, where 'ertis keys new' writes.
    """
    from ertis_numba.network.allow_list import ROLES, AllowList, Permission
    from ertis_numba.network.keys import public_key

    public, named = public_key(_network.key_file(key, "public"))
    if not (name or named):
        raise click.UsageError("a key that is not given as a file has no name; add --name")
    (chosen,) = (known for known in ROLES if known == role)
    permission = Permission(name=name or named, public=public, role=chosen, serials=serials)
    path = _path(listed)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    AllowList.change(path, lambda before: before.allow(permission))
    _print(path, [permission], as_json=as_json)


@keys.command()
@click.argument("who", metavar="NAME|KEY")
@_list_file
@options.as_json
def remove(*, who: str, listed: Path | None, as_json: bool) -> None:
    """Remove a key from the list; it is refused within a second, even if connected."""
    from ertis_numba.network.allow_list import AllowList

    path = _path(listed)
    before, after = AllowList.change(path, lambda before: before.remove(who))
    removed = [permission for permission in before.keys if permission not in after.keys]
    if as_json:
        options.print_json({"list": str(path), "removed": [_report(permission) for permission in removed]})
        return
    click.echo(f"{path}: removed {', '.join(permission.name for permission in removed)}")


@keys.command("list")
@_list_file
@options.as_json
def list_(*, listed: Path | None, as_json: bool) -> None:
    """List the allowed keys and their roles."""
    from ertis_numba.network.allow_list import AllowList

    path = _path(listed)
    _print(path, list(AllowList.load(path).keys) if path.exists() else [], as_json=as_json)


def _path(listed: Path | None) -> Path:
    from ertis_numba.network.allow_list import ALLOW_LIST
    from ertis_numba.network.keys import default_folder

    return listed or default_folder() / ALLOW_LIST


def _report(permission: "Permission") -> dict[str, Any]:
    return {name: getattr(permission, name) for name in ("name", "public", "role", "serials")}


def _print(path: Path, permissions: "list[Permission]", *, as_json: bool) -> None:
    if as_json:
        options.print_json({"list": str(path), "keys": [_report(permission) for permission in permissions]})
        return
    if not permissions:
        click.echo(f"{path}: no key is allowed; add keys with 'ertis keys allow'", err=True)
    widest = max((len(permission.name) for permission in permissions), default=0)
    for each in permissions:
        click.echo(f"{each.name:{widest}}  {each.role:11}  {each.public}  {' '.join(each.serials)}".rstrip())
