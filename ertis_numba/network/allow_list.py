"""Allow list of keys with their roles."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final, Literal, Self, TypeAlias, get_args

import msgspec

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.network.checksummed_toml import Checked
from ertis_numba.network.keys import require_key, require_name
from ertis_numba.network.private_files import locked, require_own, write
from ertis_numba.settings.documents import TomlTable

__all__ = ["ALLOW_LIST", "ROLES", "AllowList", "Permission", "Role"]

Role: TypeAlias = Literal["sensor", "application", "admin"]
ROLES: Final[tuple[Role, ...]] = get_args(Role)
ALLOW_LIST: Final = "allow.toml"
"""Name of the allow list in a folder of keys."""


class Permission(TomlTable, frozen=True, kw_only=True):
    """Permissions of a key.

    Attributes
    ----------
    name : str
    public : str
        The key, Z85.
    role : {"sensor", "application", "admin"}
        A sensor sends measurements of its serials and poses of their platform, an application receives products, and an
        admin may do both and change the settings of sensors.
    serials : tuple of str
        Sensors that a key with the role ``sensor`` may send for.
    """

    name: str
    public: str
    role: Role
    serials: Annotated[tuple[str, ...], msgspec.Meta(max_length=1024)] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_name(self.name)
        require_key(self.public)
        checks.choice("role", self.role, ROLES)
        if self.role == "sensor" and not self.serials:
            raise ArgumentError(
                f"{self.name} is a sensor without serials; name the sensors that it may send for (serials)"
            )
        if self.role != "sensor" and self.serials:
            raise ArgumentError(
                f"{self.name} has serials but is not a sensor; remove the serials, which only sensors have"
            )
        for serial in self.serials:
            checks.sensor_name(serial)

    def may_send(self, sensor: str) -> bool:
        """Return True if the key may send measurements of a sensor."""
        return self.role == "admin" or (self.role == "sensor" and sensor in self.serials)

    @property
    def may_receive(self) -> bool:
        """Return True if the key may receive products and status."""
        return self.role in ("application", "admin")


class AllowList(Checked, frozen=True, kw_only=True):
    """Allow list of keys.

    Attributes
    ----------
    keys : tuple of Permission
    """

    keys: tuple[Permission, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for what in ("name", "public"):
            seen: set[str] = set()
            for permission in self.keys:
                value = getattr(permission, what)
                if value in seen:
                    raise ArgumentError(f"{what} {value!r} is listed twice; list each key once, with its own name")
                seen.add(value)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a list.

        Raises
        ------
        SettingsError
            The file cannot be read or used, or other users of this machine may change it.
        """
        with suppress(OSError):  # The reader below reports it.
            require_own(Path(path))
        return super().load(path)

    def save(self, path: str | Path) -> None:
        """Write the whole list atomically; only its owner can change the file.

        Raises
        ------
        ArgumentError
            The folder does not exist.
        """
        write(Path(path), self.to_toml(), mode=0o644, overwrite=True)

    @classmethod
    def change(cls, path: str | Path, how: Callable[["AllowList"], "AllowList"]) -> tuple["AllowList", "AllowList"]:
        """Change a list, which is empty if the file does not exist; simultaneous changes are serialised.

        Returns
        -------
        tuple of AllowList
            The list before and after.

        Raises
        ------
        SettingsError
            As `load`.
        NetworkError
            The folder cannot be written.
        """
        path = Path(path)
        with locked(path.with_name(f".{path.name}.lock")):
            before = cls.load(path) if path.exists() else cls()
            after = how(before)
            after.save(path)
        return before, after

    def allow(self, permission: Permission) -> "AllowList":
        """Return the list with a key added; it replaces earlier permissions of the key.

        Raises
        ------
        ArgumentError
            Another key has this name.
        """
        others = tuple(each for each in self.keys if each.public != permission.public)
        if any(each.name == permission.name for each in others):
            raise ArgumentError(
                f"another key is listed as {permission.name!r}; remove it first, or choose another name (name)"
            )
        return AllowList(keys=(*others, permission))

    def remove(self, who: str) -> "AllowList":
        """Return the list without a key, given by its name or its text.

        Raises
        ------
        ArgumentError
            The key is not in the list.
        """
        others = tuple(each for each in self.keys if who not in (each.name, each.public))
        if len(others) == len(self.keys):
            checks.choice("key", who, (each.name for each in self.keys))
        return AllowList(keys=others)

    def find(self, public: str) -> Permission | None:
        """Return the permissions of a key; None if it is not in the list."""
        return next((each for each in self.keys if each.public == public), None)
