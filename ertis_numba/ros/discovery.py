"""Discovery of other programs in a DDS domain."""

import time
from dataclasses import dataclass
from typing import Any, Final

from ertis_numba.ros.participant import Participant

__all__ = ["FoundSubscriber", "discover"]

_TURN_S: Final = 0.05
_MAX_SAMPLES: Final = 1000


@dataclass(frozen=True, slots=True)
class FoundSubscriber:
    """Subscriber of a ROS 2 topic."""

    topic: str  # ROS name, as in /front/points
    message: str
    is_reliable: bool  # receives nothing from best-effort publishers


def discover(participant: Participant, wait_s: float = 2.0) -> tuple[int, list[FoundSubscriber]]:
    """Return the number of other participants that announce themselves, and the subscribers of ROS 2 topics."""
    from cyclonedds.builtin import (  # noqa: PLC0415  an extra
        BuiltinDataReader,
        BuiltinTopicDcpsParticipant,
        BuiltinTopicDcpsSubscription,
    )
    from cyclonedds.qos import Policy  # noqa: PLC0415  an extra

    own = participant.domain_participant
    participants = BuiltinDataReader(own, BuiltinTopicDcpsParticipant)
    subscriptions = BuiltinDataReader(own, BuiltinTopicDcpsSubscription)
    found: dict[Any, Any] = {}
    end_s = time.monotonic() + wait_s
    others: set[Any] = set()
    while time.monotonic() < end_s:
        others |= {each.key for each in participants.take(_MAX_SAMPLES)} - {own.guid}
        found |= {each.key: each for each in subscriptions.take(_MAX_SAMPLES)}
        time.sleep(_TURN_S)
    subscribers = [
        FoundSubscriber(
            topic=each.topic_name.removeprefix("rt"),
            message=each.type_name.replace("::dds_", "").removesuffix("_").replace("::", "/"),
            is_reliable=isinstance(each.qos[Policy.Reliability], Policy.Reliability.Reliable),
        )
        for each in found.values()
        if each.topic_name.startswith("rt/")
    ]
    return len(others), sorted(subscribers, key=lambda each: each.topic)
