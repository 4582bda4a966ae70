"""Keys of nodes: what each proves by who it is."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import platformdirs
import zmq
from zmq.utils import z85

from ertis_numba.errors import ArgumentError, SettingsError
from ertis_numba.network.checked import Checked
from ertis_numba.network.own_files import OTHERS, mode_of, private_folder, require_own, write

__all__ = ["ClientKeys", "KeyPair", "ServerKeys", "default_folder", "public_key", "require_key", "require_name"]

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]{0,63}", re.ASCII)
_Z85: Final = re.compile(r"[0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")  # ZeroMQ RFC 32


class _Public(Checked, frozen=True, kw_only=True):
    name: str
    public: str


class _Secret(Checked, frozen=True, kw_only=True):
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
        require_name(self.name)
        require_key(self.public)
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
        while public.startswith(b"-"):  # as one in 85 does, and a command would take it for an option
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
            mode, folder_mode = mode_of(path), mode_of(path.parent)
        except OSError as error:
            raise SettingsError(f"{path}: {error.strerror}; make keys by 'ertis keys new'") from error
        if mode & OTHERS:
            raise SettingsError(
                f"{path} holds a secret and others may use it (mode {mode:04o}); "
                f"run 'chmod 600 {path}', and make new keys if somebody has read it"
            )
        if folder_mode & OTHERS:
            raise SettingsError(
                f"{path} holds a secret and others may use its folder (mode {folder_mode:04o}); "
                f"run 'chmod 700 {path.parent}', or move it to a folder of its own"
            )
        require_own(path, "holds a secret")
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
        folder = private_folder(Path(folder))
        secret, public = folder / f"{self.name}.secret.toml", folder / f"{self.name}.public.toml"
        for path in (secret, public):
            if path.exists():
                raise ArgumentError(f"{path} exists; give another name, or take it away if nothing uses it")
        write(secret, _Secret(name=self.name, public=self.public, secret=self.secret).to_toml(), mode=0o600)
        write(public, _Public(name=self.name, public=self.public).to_toml(), mode=0o644)
        return secret, public


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
        require_key(self.server)


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
        require_key(read.public)
        require_name(read.name)
    except ArgumentError as error:
        raise SettingsError(f"{path}: {error}") from error
    return read.public, read.name


def require_name(name: str) -> None:
    """Refuse what cannot be the name of a key.

    Raises
    ------
    ArgumentError
        It cannot.
    """
    if not _NAME.fullmatch(name):
        raise ArgumentError(f"name {name!r} cannot be that of a key; give up to 64 letters, digits and _ . @ + -")


def _is_key(key: str) -> bool:
    """Whether a text is a key in Z85: five characters for each four bytes, which not every five are."""
    try:
        return bool(_Z85.fullmatch(key)) and len(z85.decode(key)) == 32
    except Exception:  # noqa: BLE001  whatever it is that cannot be decoded
        return False


def require_key(key: str) -> None:
    """Refuse what is no key.

    Raises
    ------
    ArgumentError
        It is none.
    """
    if not _is_key(key):
        raise ArgumentError(f"key {key[:48]!r} is none; give the 40 characters that 'ertis keys list' shows")
