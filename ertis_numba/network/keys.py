"""CURVE keys of nodes."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import platformdirs
import zmq
from zmq.utils import z85

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.network.checksummed_toml import Checked
from ertis_numba.network.private_files import OTHERS, mode_of, private_folder, require_own, write

__all__ = ["ClientKeys", "KeyPair", "ServerKeys", "default_folder", "public_key", "require_key", "require_name"]

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]{0,63}", re.ASCII)
_Z85: Final = re.compile(r"[0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")  # Pattern of ZeroMQ RFC 32.


class _Public(Checked, frozen=True, kw_only=True):
    name: str
    public: str


class _Secret(Checked, frozen=True, kw_only=True):
    name: str
    public: str
    secret: str


@dataclass(frozen=True, slots=True)
class KeyPair:
    """CURVE key pair that proves the identity of a node.

    Attributes
    ----------
    public : str
        Public key, Z85 (ZeroMQ RFC 32), 40 characters.
    secret : str
        Secret key, in the same form.
    name : str
    """

    public: str
    secret: str = field(repr=False)
    name: str

    def __post_init__(self) -> None:
        require_name(self.name)
        require_key(self.public)
        if not _is_key(self.secret) or zmq.curve_public(self.secret.encode()).decode() != self.public:
            raise ArgumentError(f"the secret key of {self.name} does not belong to its public key; create new keys")

    @classmethod
    def new(cls, name: str) -> Self:
        """Return new keys.

        Raises
        ------
        ArgumentError
            The name cannot be a file name.
        """
        public, secret = zmq.curve_keypair()
        while public.startswith(b"-"):  # 1 key in 85 does, and a command would take it for an option.
            public, secret = zmq.curve_keypair()
        return cls(public.decode(), secret.decode(), name)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the keys that `save` has written.

        Parameters
        ----------
        path : str or Path
            File with the secret key.

        Raises
        ------
        SettingsError
            The file cannot be read or used, or other users of this machine may use it or its folder.
        """
        path = Path(path)
        if path.name.endswith(".public.toml"):
            raise SettingsError(
                f"{path} contains a public key; use the secret key in the .secret.toml file of the same name"
            )
        try:
            mode, folder_mode = mode_of(path), mode_of(path.parent)
        except OSError as error:
            raise SettingsError(f"{path}: {error.strerror}; create keys with 'ertis keys new'") from error
        if mode & OTHERS:
            raise SettingsError(
                f"{path} contains a secret, but other users may read it (mode {mode:04o}); run 'chmod 600 "
                f"{path}', and create new keys if somebody has read it"
            )
        if folder_mode & OTHERS:
            raise SettingsError(
                f"{path} contains a secret, but other users may use its folder (mode {folder_mode:04o}); run "
                f"'chmod 700 {path.parent}', or move it to a separate folder"
            )
        require_own(path, "contains a secret")
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
            Folder of the files; created for its owner alone if it does not exist.

        Returns
        -------
        tuple of Path
            Files of the secret and of the public key.

        Raises
        ------
        ArgumentError
            Keys of this name exist, or other users may use the folder.
        """
        folder = private_folder(Path(folder))
        secret, public = folder / f"{self.name}.secret.toml", folder / f"{self.name}.public.toml"
        for path in (secret, public):
            if path.exists():
                raise ArgumentError(f"{path} exists; choose another name, or remove the file if nothing uses it")
        write(secret, _Secret(name=self.name, public=self.public, secret=self.secret).to_toml(), mode=0o600)
        write(public, _Public(name=self.name, public=self.public).to_toml(), mode=0o644)
        return secret, public


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """Keys of a central node.

    Attributes
    ----------
    pair : KeyPair
    allow : Path
        File of the `AllowList`. Other keys are refused.
    """

    pair: KeyPair
    allow: Path


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """Keys of a sensor node or an application node.

    Attributes
    ----------
    pair : KeyPair
    server : str
        Public key of the central node, Z85. The node talks to no other.
    """

    pair: KeyPair
    server: str

    def __post_init__(self) -> None:
        require_key(self.server)


def default_folder() -> Path:
    """Return the folder of this user's keys; ``ERTIS_KEYS_DIR`` names another."""
    given = os.environ.get("ERTIS_KEYS_DIR")
    return Path(given) if given else Path(platformdirs.user_config_dir("ertis", appauthor=False)) / "keys"


def public_key(given: str | Path) -> tuple[str, str]:
    """Return a public key and the name of its owner, from a file or from the key itself, which has no name."""
    if _is_key(str(given)):
        return str(given), ""
    path = Path(given)
    if path.name.endswith(".secret.toml"):
        raise SettingsError(
            f"{path} contains a secret key, which must stay on its machine; use the file .public.toml beside it"
        )
    if not path.is_file():
        raise SettingsError(
            f"{str(given)!r} is neither a public key nor a file with one; use NAME.public.toml from 'ertis keys "
            "new', or the 40 characters from 'ertis keys list'"
        )
    read = _Public.load(path)
    try:
        require_key(read.public)
        require_name(read.name)
    except ArgumentError as error:
        raise SettingsError(f"{path}: {error}") from error
    return read.public, read.name


def require_name(name: str) -> None:
    """Refuse a name that a key cannot have."""
    if not _NAME.fullmatch(name):
        raise ArgumentError(f"key name {name!r} cannot be used; use up to 64 letters, digits and _ . @ + -")


def _is_key(key: str) -> bool:
    """Return True if a text is a key in Z85; some groups of five characters encode no four bytes."""
    try:
        return bool(_Z85.fullmatch(key)) and len(z85.decode(key)) == 32
    except Exception:  # noqa: BLE001  whatever it is that cannot be decoded
        return False


def require_key(key: str) -> None:
    """Refuse a text that is not a key."""
    if not _is_key(key):
        raise ArgumentError(f"{key[:48]!r} is not a key; use the 40 characters from 'ertis keys list'")
