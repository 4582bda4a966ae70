"""Power cuts at random times of commands, with checks that acknowledged measurements survive."""

import random
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from ertis_numba.base.errors import DataError
from tests.faults.powercuts import log as logs, scenarios
from tests.faults.powercuts.disk import Disk
from tests.faults.powercuts.recovery import Found, recover_archive, recover_capture, recover_spool
from tests.faults.powercuts.scenarios import AcknowledgedState, Setting, Trace

__all__ = ["SCENARIOS", "reason_not_to_try", "try_cuts"]

SCENARIOS: Final = ("capture", "journal", "record", "serve", "spool")
_SOURCE: Final = Path(__file__).parents[3] / "data" / "synthetic" / "reflectors.h5"
_CENTRAL: Final = ("record", "serve")  # scenarios that count acknowledgements of the central node
_STATES_OF_A_RUN: Final = 100
_SHARE_AFTER_ACK: Final = 0.5  # share of cuts right after an acknowledgement
_SHARE_BY_COMMAND: Final = 0.005  # share of states that the real command recovers
_MAX_FAILING_SYNCS: Final = 12  # maximum number of failing syncs per process
_FIRST_SYNC: Final = 5  # First sync that may fail. A node listens by then.


def reason_not_to_try(folder: Path) -> str:
    """Return the reason why power cuts cannot be tried on this machine, or an empty string if they can."""
    try:
        logs.build(folder)
    except DataError as error:
        return str(error)
    return ""


def try_cuts(
    folder: Path,
    *,
    seed: int,
    count: int,
    only: Sequence[str] = SCENARIOS,
    n_measurements: int = 24,
    states_of_a_run: int = _STATES_OF_A_RUN,
    say: Callable[[str], None] = lambda _: None,
    keep: Path | None = None,
) -> dict[str, Any]:
    """Cut the power ``count`` times, in equal shares over scenarios, with and without failing syncs.

    Parameters
    ----------
    folder : Path
        Empty folder.
    seed, count : int
    only : sequence of str
        Names of `SCENARIOS`.
    n_measurements : int
        Maximum number of measurements of each sensor in a run.
    states_of_a_run : int
        Power cuts tried with the log of one run.
    say : callable
        Called with a line for each error.
    keep : Path, optional
        Folder for states whose recovery is wrong.

    Returns
    -------
    dict
        ``states`` of disks, ``runs`` of commands and ``failed_syncs`` in them; measurements that were ``acknowledged``
        before the cuts; of these ``lost`` or stored ``twice``; ``wrong`` ones; recoveries that ``failed``; journals
        ``left_over``. The same counts for each scenario. If none can be tried, only a ``reason``.
    """
    reason = reason_not_to_try(folder)
    if reason:
        return {"reason": reason}
    library = folder / "disklog.so"
    rng = random.Random(seed)
    found: Counter[str] = Counter()
    kinds = [(name, fails) for name in only for fails in (False, True)]
    for number, (name, fails) in enumerate(kinds):
        wanted = count * (number + 1) // len(kinds) - count * number // len(kinds)
        of_kind: Counter[str] = Counter()
        while of_kind["states"] < wanted:
            place = folder / "run"
            place.mkdir()
            n_sent = rng.randint(min(4, n_measurements), n_measurements)
            first = _FIRST_SYNC + rng.randint(0, n_sent)  # about one sync per measurement
            fail = (first, rng.randint(1, _MAX_FAILING_SYNCS), rng.getrandbits(16)) if fails else None
            setting = Setting(folder=place, disk_log=library, seed=rng.getrandbits(31), count=n_sent, fail=fail)
            trace = _run(name, setting)
            of_kind["runs"] += 1
            _cut(name, trace, rng, min(states_of_a_run, wanted - of_kind["states"]), of_kind, say=say, keep=keep)
            shutil.rmtree(place)
        say(f"{name}{', syncs fail' if fails else ''}: {dict(of_kind)}")
        found.update(of_kind)
        found.update({f"{name}{' with failing syncs' if fails else ''} {what}": n for what, n in of_kind.items()})
    return {"lost": 0, "twice": 0, "wrong": 0, "failed": 0, "left_over": 0} | dict(found)


def _run(name: str, setting: Setting) -> Trace:
    if name == "capture":
        return scenarios.capture(setting, _SOURCE)
    if name == "journal":
        return scenarios.journal(setting)
    if name == "spool":
        return scenarios.spool(setting)
    return scenarios.central(setting, name)


def _cut(
    name: str,
    trace: Trace,
    rng: random.Random,
    count: int,
    found: Counter[str],
    *,
    say: Callable[[str], None],
    keep: Path | None,
) -> None:
    """Cut the power at several times of a run, recover, and count errors."""
    records = list(logs.read(trace.setting.log))
    acks = [place for place, record in enumerate(records) if record.kind is logs.DiskOperation.ACK]
    found["failed_syncs"] += sum(record.kind is logs.DiskOperation.SYNC_FAIL for record in records)
    moments: Counter[int] = Counter()
    for _ in range(count):
        after_ack = acks and rng.random() < _SHARE_AFTER_ACK
        moments[rng.choice(acks) if after_ack else rng.randrange(len(records))] += 1
    disk, acknowledged = Disk(trace.setting.disk), AcknowledgedState()
    state = trace.setting.folder / "state"
    for place, record in enumerate(records):
        disk.take(record)
        acknowledged.take(record)
        for _ in range(moments[place]):
            disk.cut(state, rng)
            if keep is not None:
                kept = shutil.copytree(state, keep / f"{name}-{keep.stat().st_nlink}-{place}-{found['states']}")
            one = _recover(name, trace, state, acknowledged, rng)
            found["states"] += 1
            found["acknowledged"] += len(acknowledged.sent.acked() if name in _CENTRAL else acknowledged.sent.kept)
            found.update(one)
            if any(one.values()):
                say(f"{name} {trace.setting.fail} at record {place} of {len(records)}: {one}")
            elif keep is not None:
                shutil.rmtree(kept)
            shutil.rmtree(state)


def _recover(name: str, trace: Trace, state: Path, acknowledged: AcknowledgedState, rng: random.Random) -> Found:
    by_command = rng.random() < _SHARE_BY_COMMAND
    if name in ("capture", "journal"):
        return recover_capture(state, acknowledged.sent, trace.sent_crc32, by_command=by_command)
    if name == "spool":
        return recover_spool(state, acknowledged.sent)
    return recover_archive(state, acknowledged.sent, rng, by_command=by_command)
