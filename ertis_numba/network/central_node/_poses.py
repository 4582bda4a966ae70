"""Intake of the poses of platforms, which applications send."""

import time
from dataclasses import dataclass
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.journal import JournalPose
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.messages import SILENCE_LIMIT_S, PlatformPose

__all__ = ["MAX_RATE_HZ", "PoseIntake"]

MAX_RATE_HZ: Final = 200
"""Limit on the poses of a sender per second."""

_SENDERS: Final = 64


@dataclass(slots=True)
class _Sender:
    """Sender of poses: its connection and sensors, the time of its last message, and how many poses it may send now."""

    peer_id: bytes
    sensors: tuple[str, ...]
    heard_s: float
    allowance: float = MAX_RATE_HZ


class PoseIntake:
    """Receiver of poses from one sender per sensor, until it is silent for some seconds; sessions identify senders."""

    def __init__(self, store: Archive | None) -> None:
        self._store = store
        self._senders: dict[int, _Sender] = {}  # By session.

    def add(self, peer_id: bytes, pose: PlatformPose, who: Permission) -> None:
        """Queue a pose to be stored."""
        if self._store is None:
            raise Unwanted(
                "message",
                "this central node writes no recordings that could hold poses; start it with --record",
                "pose",
            )
        for sensor in pose.sensors:
            if not who.may_send(sensor):
                raise Unwanted(
                    "serial",
                    f"key {who.name} may not send for sensor {sensor}; allow it with 'ertis keys allow'",
                    "serial",
                )
        self._count(peer_id, pose, time.monotonic())  # Before the numbers are checked, which takes longer.
        self._store.offer_pose(_checked(pose))

    def bye(self, peer_id: bytes) -> None:
        """Forget a sender, so that another one may send poses of its sensors."""
        self._senders = {number: sender for number, sender in self._senders.items() if sender.peer_id != peer_id}

    def _count(self, peer_id: bytes, pose: PlatformPose, now_s: float) -> None:
        """Refuse a second sender for a sensor, and a sender whose rate is too high."""
        for session_id, other in list(self._senders.items()):
            if now_s - other.heard_s > SILENCE_LIMIT_S:
                del self._senders[session_id]
            elif session_id != pose.session_id and (shared := set(pose.sensors).intersection(other.sensors)):
                raise Unwanted(
                    "sensor",
                    f"another application already sends poses for sensor {min(shared)}; end one of them, or wait until "
                    f"the other has been silent for {SILENCE_LIMIT_S:g} s",
                    "pose",
                )
        if pose.session_id not in self._senders and len(self._senders) >= _SENDERS:
            raise Unwanted("size", f"{_SENDERS} applications already send poses; end one of them", "too many")
        sender = self._senders.setdefault(pose.session_id, _Sender(peer_id, pose.sensors, now_s))
        allowance = min(MAX_RATE_HZ, sender.allowance + MAX_RATE_HZ * (now_s - sender.heard_s))
        sender.peer_id, sender.sensors, sender.heard_s = peer_id, pose.sensors, now_s
        sender.allowance = allowance - 1 if allowance >= 1 else allowance
        if allowance < 1:
            raise Unwanted("size", f"poses exceed {MAX_RATE_HZ} per second; send fewer", "rate")


def _checked(pose: PlatformPose) -> JournalPose:
    """Return a pose for the journal, or refuse one with impossible numbers."""
    try:
        made = pose.trajectory
    except ArgumentError as error:
        raise Unwanted("message", f"invalid pose: {error}", "pose") from error
    return JournalPose(
        pose.sensors,
        pose.timestamp_ns,
        tuple(made.position_m[0].tolist()),
        tuple(made.rotation_xyzw[0].tolist()),
        b"" if made.covariance is None else made.covariance.astype("<f8").tobytes(),
        made.source,
    )
