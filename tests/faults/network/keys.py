"""Trials of access control with invalid and valid keys.

Each wrong key and role is tried at both addresses of a central node, together with the right ones.
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from ertis_bench.network.diary import Diary, DiaryKey, Row
from ertis_bench.network.processes import until
from ertis_bench.network.sender import SMALL
from ertis_bench.network_trials.oracle import judged

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.network.allow_list import AllowList
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.network.subscriber import Subscriber
from tests.faults.network.keyed_node import KeyedNode
from tests.faults.network.zmtp import ZmtpPeer

__all__ = ["keys", "try_keys"]

_TRIED_S: Final = 2.5  # long enough for several refusals of a wrong key
_REMOVED_S: Final = 2.0
_PATIENCE_S: Final = 60.0  # time limit for what must happen, after these times
_LISTED: Final = "the listed application"
_REFUSALS: Final = {"unknown key", "no key", "role", "serial"}
_INTERVAL_S: Final = 0.05
Found = dict[str, Any]


@dataclass(slots=True, kw_only=True)
class _Client:
    """Sensor node that must be accepted or refused."""

    node: SensorNode
    sensor: str
    diary: Diary
    session_id: int
    sent: int = 0
    acked_through: int = -1
    acked_s: float = 0.0
    notes: list[str] = field(default_factory=list)

    def note_acked(self, message: Any) -> None:
        """Record an acknowledgement, with its time."""
        self.acked_through, self.acked_s = max(self.acked_through, message.acked_through), time.monotonic()
        self.diary.acked_through(
            message.sensor, message.session_id, message.acked_through, message.status, time.monotonic_ns()
        )

    def send(self) -> None:
        """Hand over one measurement."""
        words = np.random.default_rng([self.session_id, self.sent]).integers(0, 2**32, 32_768, dtype=np.uint32)
        measurement = Measurement(
            words, SMALL, Stamp(sensor=self.sensor, sequence=self.sent, session_id=self.session_id)
        )
        now_ns, key = time.monotonic_ns(), DiaryKey(self.sensor, self.session_id, self.sent)
        self.diary.offered(key, Row.of(measurement), now_ns)
        self.node.append([JournalEntry(measurement, monotonic_ns=now_ns)])
        self.diary.kept(key)
        self.sent += 1


def keys(folder: Path, *, seed: int) -> Found:
    """Try all keys.

    Returns
    -------
    dict
        Results of `try_keys`, and results for the recordings, which may contain the listed sensor only.
    """
    with KeyedNode.running(folder) as keyed:
        found, wanted, removed = try_keys(keyed, folder, seed=seed)
        keyed.node.stop()
    return found | judged(folder, keyed.archive, [wanted, removed], kept=[wanted])


def try_keys(keyed: KeyedNode, folder: Path, *, seed: int) -> tuple[Found, Path, Path]:
    """Try all keys at a running node, and return the results, and the diaries of the listed and the removed sensor.

    Returns
    -------
    dict
        ``let in``, names of nodes that were accepted. ``refused``, refusals by reason, as the central node counts them.
        ``notes``, messages to the refused nodes. ``removed, s``, seconds from the removal of a key to the last
        acknowledgement to its owner.
    listed, removed : Path
    """
    with ExitStack() as stack:
        wrong_server = ClientKeys(pair=keyed.pairs["front"], server=keyed.pairs["stranger"].public)
        cases: dict[str, tuple[str, ClientKeys | None]] = {
            "the listed sensor": ("front", keyed.client("front")),
            "a listed sensor, until it is removed": ("leaver", keyed.client("leaver")),
            "no key": ("front", None),
            "an unknown key": ("front", keyed.client("stranger")),
            "the wrong server key": ("front", wrong_server),
            "an application that sends": ("front", keyed.client("viewer")),
            "a sensor that sends for another": ("rear", keyed.client("front")),
        }
        diaries = {name: folder / f"{number}.ndjson" for number, name in enumerate(cases)}
        tries = {
            name: _start_client(stack, keyed.address, sensor, given, diaries[name], session_id=seed + number)
            for number, (name, (sensor, given)) in enumerate(cases.items())
        }
        _send(list(tries.values()), _TRIED_S, lambda: keyed.status()["refused"].keys() >= _REFUSALS)
        watchers = {
            "no key that subscribes": None,
            "an unknown key that subscribes": keyed.client("stranger"),
            "a sensor that subscribes": keyed.client("front"),
            _LISTED: keyed.client("viewer"),
        }
        let_in = _receivers(keyed.publish, watchers, tries["the listed sensor"])
        removed_s = time.monotonic()
        AllowList.load(keyed.allowed).remove("leaver").save(keyed.allowed)
        leaver = tries.pop("a listed sensor, until it is removed")
        _send([tries["the listed sensor"], leaver], _REMOVED_S, lambda: "removed key" in keyed.status()["refused"])
        after_s = leaver.acked_s - removed_s
        raw = _accepts_without_keys(keyed.address) + _accepts_without_keys(keyed.publish)
        status = keyed.status()
        until(lambda: tries["the listed sensor"].acked_through >= tries["the listed sensor"].sent - 1)
        let_in += [name for name, each in tries.items() if each.acked_through >= 0]
        notes = sorted({note for name, each in tries.items() if name not in let_in for note in each.notes})
    found = {
        "tried": len(cases) + len(watchers) + 2,
        "let in": sorted(let_in),
        "raw": raw,
        "refused": status["refused"],
        "notes": notes,
        "unsettled when removed": leaver.sent - 1 - leaver.acked_through,
        "removed, s": round(max(0.0, after_s), 2),
    }
    return found, diaries["the listed sensor"], diaries["a listed sensor, until it is removed"]


def _start_client(
    stack: ExitStack, address: str, sensor: str, given: ClientKeys | None, diary: Path, *, session_id: int
) -> _Client:
    """Start a sensor node."""
    notes: list[str] = []
    node = stack.enter_context(
        SensorNode(
            address,
            keys=given,
            on_acked=lambda message: made.note_acked(message),  # noqa: PLW0108  it is made below
            on_note=lambda *texts: notes.append(": ".join(texts)),
        )
    )
    made = _Client(node=node, sensor=sensor, diary=Diary(diary), session_id=session_id, notes=notes)
    node.add_sensor(sensor, SMALL)
    return made


def _send(tries: Sequence[_Client], duration_s: float, is_enough: Callable[[], bool]) -> None:
    """Send measurements of all nodes in turns for some time, and then until a condition holds or patience ends."""
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s or (time.monotonic() < end_s + _PATIENCE_S and not is_enough()):
        for each in tries:
            each.send()
        time.sleep(_INTERVAL_S * len(tries))


def _receivers(address: str, watchers: dict[str, ClientKeys | None], sender: _Client) -> list[str]:
    """Return the names of receivers that receive anything while the listed sensor sends.

    The listed application must receive something.
    """
    found = set[str]()
    with ExitStack() as stack:
        subscribers = {
            name: stack.enter_context(Subscriber(address, products=("energyscape",), keys=given))
            for name, given in watchers.items()
        }
        end_s = time.monotonic() + _TRIED_S
        while time.monotonic() < end_s or (time.monotonic() < end_s + _PATIENCE_S and _LISTED not in found):
            sender.send()
            for name, subscriber in subscribers.items():
                with contextlib.suppress(ErtisError):  # The receiver may raise an error for the refusal.
                    if subscriber.receive(timeout_s=0.02) is not None:
                        found.add(name)
    return sorted(found)


def _accepts_without_keys(address: str) -> int:
    """Return 1 if an address completes a handshake with a peer without keys, otherwise 0."""
    with contextlib.suppress(OSError), ZmtpPeer(address, timeout_s=1.0):
        return 1
    return 0
