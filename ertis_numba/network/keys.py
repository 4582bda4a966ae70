"""Keys of nodes, and the list of those that are let in."""

import os
import re
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal, Self, TypeAlias, get_args

import msgspec
import platformdirs
import zmq
from zmq.utils import z85

from ertis_numba import checks
from ertis_numba.atomic import replacing
from ertis_numba.documents import Document, Table
from ertis_numba.errors import ArgumentError, NetworkError, SettingsError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = [
    "ALLOW_LIST",
    "ROLES",
    "AllowList",
    "ClientKeys",
    "KeyPair",
    "Permission",
    "Role",
    "ServerKeys",
    "default_folder",
    "public_key",
    "require_own",
]

Role: TypeAlias = Literal["sensor", "application", "admin"]
ROLES: Final[tuple[Role, ...]] = get_args(Role)
ALLOW_LIST: Final = "allow.toml"
"""Name of the list of permissions in a folder of keys."""

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]{0,63}", re.ASCII)
_Z85: Final = re.compile(r"[0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")  # ZeroMQ RFC 32
_OTHERS: Final = 0o077
_OTHERS_WRITE: Final = 0o022


class _Public(Document, frozen=True, kw_only=True):
    name: str
    public: str


class _Secret(Document, frozen=True, kw_only=True):
    name: str
    public: str
    secret: str


@dataclass(frozen=True, slots=True)
class KeyPair:
    """What a node proves by who it is.

    Attributes
    ----------
    public : str
        Z85 (ZeroMQ RFC 32), 40 characters; others may know it.
    secret : str
        The same; nobody else may.
    name : str
    """

    public: str
    secret: str = field(repr=False)
    name: str

    def __post_init__(self) -> None:
        _require_name(self.name)
        _require_key(self.public)
        if not _is_key(self.secret) or zmq.curve_public(self.secret.encode()).decode() != self.public:
            raise ArgumentError(f"the secret key of {self.name} does not belong to its public key; make new ones")

    @classmethod
    def new(cls, name: str) -> Self:
        """Return new keys.

        Raises
        ------
        ArgumentError
            The name cannot be that of a file.
        """
        public, secret = zmq.curve_keypair()
        return cls(public.decode(), secret.decode(), name)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the keys that `save` has written.

        Parameters
        ----------
        path : str or Path
            Of the file with the secret key.

        Raises
        ------
        SettingsError
            It cannot be read or used, or others on this machine may use it or its folder, too.
        """
        path = Path(path)
        if path.name.endswith(".public.toml"):
            raise SettingsError(f"{path} holds a public key; give the file .secret.toml of the same name")
        try:
            mode, folder_mode = _mode(path), _mode(path.parent)
        except OSError as error:
            raise SettingsError(f"{path}: {error.strerror}; make keys by 'ertis keys new'") from error
        if mode & _OTHERS:
            raise SettingsError(
                f"{path} holds a secret and others may use it (mode {mode:04o}); "
                f"run 'chmod 600 {path}', and make new keys if somebody has read it"
            )
        if folder_mode & _OTHERS:
            raise SettingsError(
                f"{path} holds a secret and others may use its folder (mode {folder_mode:04o}); "
                f"run 'chmod 700 {path.parent}', or move it to a folder of its own"
            )
        read = _Secret.load(path)
        try:
            return cls(read.public, read.secret, read.name)
        except ArgumentError as error:
            raise SettingsError(f"{path}: {error}") from error

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write ``NAME.secret.toml``, which only its owner can read, and ``NAME.public.toml``.

        Parameters
        ----------
        folder : str or Path
            It is made if it is not there, for its owner alone.

        Returns
        -------
        tuple of Path
            Of the secret and of the public key.

        Raises
        ------
        ArgumentError
            There are keys of this name already, or others may use the folder.
        """
        folder = _private(Path(folder))
        secret, public = folder / f"{self.name}.secret.toml", folder / f"{self.name}.public.toml"
        for path in (secret, public):
            if path.exists():
                raise ArgumentError(f"{path} exists; give another name, or take it away if nothing uses it")
        _write(secret, _Secret(name=self.name, public=self.public, secret=self.secret).to_toml(), mode=0o600)
        _write(public, _Public(name=self.name, public=self.public).to_toml(), mode=0o644)
        return secret, public


class Permission(Table, frozen=True, kw_only=True):
    """What the owner of a key may do.

    Attributes
    ----------
    name : str
    public : str
        The key, Z85.
    role : {"sensor", "application", "admin"}
        A sensor sends measurements of its serials, an application receives products, an admin may do both.
    serials : tuple of str
        Of a sensor: the names of those that it may send for, each of them.
    """

    name: str
    public: str
    role: Role
    serials: Annotated[tuple[str, ...], msgspec.Meta(max_length=1024)] = ()

    def __post_init__(self) -> None:
        _require_name(self.name)
        _require_key(self.public)
        checks.choice("role", self.role, ROLES)
        if self.role == "sensor" and not self.serials:
            raise ArgumentError(f"{self.name} is a sensor without serials; name those that it may send for (--serial)")
        if self.role != "sensor" and self.serials:
            raise ArgumentError(f"{self.name} has serials and is no sensor; give serials to sensors only")
        for serial in self.serials:
            checks.sensor_name(serial)

    def may_send(self, sensor: str) -> bool:
        """Whether it may send measurements of a sensor."""
        return self.role == "admin" or (self.role == "sensor" and sensor in self.serials)

    @property
    def may_receive(self) -> bool:
        """Whether it may receive products and status."""
        return self.role in ("application", "admin")


class AllowList(Document, frozen=True, kw_only=True):
    """Who is let in, and as what.

    Attributes
    ----------
    keys : tuple of Permission
    """

    keys: tuple[Permission, ...] = ()

    def __post_init__(self) -> None:
        for what in ("name", "public"):
            seen: set[str] = set()
            for permission in self.keys:
                value = getattr(permission, what)
                if value in seen:
                    raise ArgumentError(f"{what} {value!r} is listed twice; list each key once, by a name of its own")
                seen.add(value)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a list.

        Raises
        ------
        SettingsError
            It cannot be read or used, or others on this machine may change it.
        """
        with suppress(OSError):  # which is told of below
            require_own(Path(path))
        return super().load(path)

    def save(self, path: str | Path) -> None:
        """Write the list, as a whole or not at all; only its owner can change it.

        Raises
        ------
        ArgumentError
            There is no such folder.
        """
        _write(Path(path), self.to_toml(), mode=0o644, overwrite=True)

    @classmethod
    def change(cls, path: str | Path, how: Callable[["AllowList"], "AllowList"]) -> tuple["AllowList", "AllowList"]:
        """Change a list, which is empty before it is made; two that do so at once lose nothing of each other's.

        Returns
        -------
        tuple of AllowList
            Before and after.

        Raises
        ------
        SettingsError
            As `load`.
        NetworkError
            Its folder cannot be written.
        """
        path = Path(path)
        with _locked(path.with_name(f".{path.name}.lock")):
            before = cls.load(path) if path.exists() else cls()
            after = how(before)
            after.save(path)
        return before, after

    def allow(self, permission: Permission) -> "AllowList":
        """Return the list with a key in it, instead of what that key had before.

        Raises
        ------
        ArgumentError
            Another key has this name.
        """
        others = tuple(each for each in self.keys if each.public != permission.public)
        if any(each.name == permission.name for each in others):
            raise ArgumentError(f"another key is listed as {permission.name!r}; remove it first, or give --name")
        return AllowList(keys=(*others, permission))

    def remove(self, who: str) -> "AllowList":
        """Return the list without a key, given by its name or itself.

        Raises
        ------
        ArgumentError
            It is not in the list.
        """
        others = tuple(each for each in self.keys if who not in (each.name, each.public))
        if len(others) == len(self.keys):
            checks.choice("key", who, (each.name for each in self.keys))
        return AllowList(keys=others)

    def find(self, public: str) -> Permission | None:
        """Return what a key may do; None if it is not in the list."""
        return next((each for each in self.keys if each.public == public), None)


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """What a central node needs.

    Attributes
    ----------
    pair : KeyPair
    allow : Path
        Of the `AllowList`; who is not in it gets nothing in or out.
    """

    pair: KeyPair
    allow: Path


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """What a sensor or application node needs.

    Attributes
    ----------
    pair : KeyPair
    server : str
        Public key of the central node, Z85: no other is spoken to.
    """

    pair: KeyPair
    server: str

    def __post_init__(self) -> None:
        _require_key(self.server)


def default_folder() -> Path:
    """Return the folder of the keys of this user; ``ERTIS_KEYS_DIR`` names another."""
    given = os.environ.get("ERTIS_KEYS_DIR")
    return Path(given) if given else Path(platformdirs.user_config_dir("ertis", appauthor=False)) / "keys"


def public_key(given: str | Path) -> tuple[str, str]:
    """Return a public key and the name of its owner, from a file or from the key itself, which has no name.

    Raises
    ------
    SettingsError
        The file cannot be read or used.
    """
    if _is_key(str(given)):
        return str(given), ""
    path = Path(given)
    if path.name.endswith(".secret.toml"):
        raise SettingsError(f"{path} holds a secret key, which nobody else needs; give the file .public.toml beside it")
    if not path.is_file():
        raise SettingsError(
            f"{str(given)!r} is neither a public key nor a file of one; give NAME.public.toml from 'ertis keys new', "
            "or the 40 characters that 'ertis keys list' shows"
        )
    read = _Public.load(path)
    try:
        _require_key(read.public)
        _require_name(read.name)
    except ArgumentError as error:
        raise SettingsError(f"{path}: {error}") from error
    return read.public, read.name


def _require_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ArgumentError(f"name {name!r} cannot be that of a key; give up to 64 letters, digits and _ . @ + -")


def _is_key(key: str) -> bool:
    """Whether a text is a key in Z85: five characters for each four bytes, which not every five are."""
    try:
        return bool(_Z85.fullmatch(key)) and len(z85.decode(key)) == 32
    except Exception:  # noqa: BLE001  whatever it is that cannot be decoded
        return False


def _require_key(key: str) -> None:
    if not _is_key(key):
        raise ArgumentError(f"key {key[:48]!r} is none; give the 40 characters that 'ertis keys list' shows")


def _private(folder: Path) -> Path:
    """Return a folder that only its owner can use, made if it is not there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = _mode(folder)
    except OSError as error:
        raise NetworkError(f"{folder}: {error.strerror}; give a folder that can be written (--dir)") from error
    if mode & _OTHERS:
        raise ArgumentError(
            f"{folder} can be used by others (mode {mode:04o}); run 'chmod 700 {folder}', or give another (--dir)"
        )
    return folder


def require_own(path: Path) -> None:
    """Refuse a list of keys that others on this machine may change, by itself or by another in its place.

    Raises
    ------
    SettingsError
        They may.
    """
    for where, what in ((path, "it"), (path.parent, "its folder")):
        mode = _mode(where)
        if mode & _OTHERS_WRITE and not mode & stat.S_ISVTX:
            raise SettingsError(
                f"{path} says who is let in and others may change {what} (mode {mode:04o}); "
                f"run 'chmod go-w {where}', and look at what it says"
            )


def _mode(path: Path) -> int:
    """Return who may use a file or folder; nobody else, where a system does not say."""
    return stat.S_IMODE(path.stat().st_mode) if os.name == "posix" else 0


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait until nobody else is in such a block; a process that ends leaves it."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    except OSError as error:
        raise NetworkError(f"{path.parent}: {error.strerror}; give a folder that can be written") from error
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_LOCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _write(path: Path, text: str, *, mode: int, overwrite: bool = False) -> None:
    """Write a file that was never open to more than it is to be open to."""
    with replacing(path, overwrite=overwrite) as part:
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
