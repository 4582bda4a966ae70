"""Central node with keys and an allow list, for trials of encrypted connections."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from ertis_bench.network.processes import JsonLinesProcess, central

from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair
from tests.faults.network.links import state_of

__all__ = ["KeyedNode"]


@dataclass(frozen=True, slots=True)
class KeyedNode:
    """``ertis serve`` that accepts two sensors, an application and an admin; use it in a ``with`` statement.

    Attributes
    ----------
    node : JsonLinesProcess
    pairs : dict of str to KeyPair
        Keys of ``central``, of the listed ``front``, ``leaver``, ``viewer`` and ``boss``, and of a ``stranger``.
    keys, archive, allowed : Path
        Folders of keys and of recordings, and the allow list.
    address, publish : str
    """

    node: JsonLinesProcess
    pairs: dict[str, KeyPair]
    keys: Path
    archive: Path
    allowed: Path
    address: str
    publish: str

    @classmethod
    @contextmanager
    def running(cls, folder: Path) -> Iterator[Self]:
        """Create the keys, start the node and yield it."""
        archive, allowed, keys = folder / "recordings", folder / "allow.toml", folder / "keys"
        archive.mkdir()
        pairs = {name: KeyPair.new(name) for name in ("central", "front", "stranger", "viewer", "leaver", "boss")}
        for pair in pairs.values():
            pair.save(keys)
        listed = (
            Permission(name="front", public=pairs["front"].public, role="sensor", serials=("front",)),
            Permission(name="leaver", public=pairs["leaver"].public, role="sensor", serials=("leaver",)),
            Permission(name="viewer", public=pairs["viewer"].public, role="application"),
            Permission(name="boss", public=pairs["boss"].public, role="admin"),
        )
        AllowList(keys=listed).save(allowed)
        options = ["--key", str(keys / "central.secret.toml"), "--allow", str(allowed), "--workers", "1"]
        options += ["--publish", "tcp://127.0.0.1:*", "--record", str(archive), "--directions", "2d:9"]
        with central("serve", folder, *options) as node:
            listening = node.wait_for("listening")
            yield cls(node, pairs, keys, archive, allowed, listening["address"], listening["publish"])

    @property
    def server(self) -> str:
        """Public key of the node."""
        return self.pairs["central"].public

    def client(self, name: str) -> ClientKeys:
        """Return the keys with which a client connects."""
        return ClientKeys(pair=self.pairs[name], server=self.server)

    def status(self) -> dict[str, Any]:
        """Return the status, as the admin sees it."""
        return state_of(self.address, "--key", str(self.keys / "boss.secret.toml"), "--server-key", self.server)
