"""Parameters of the node, and the options and settings of ``ertis ros`` that they stand for."""

import shlex
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor

from ertis_numba.ros import PublishingSettings

__all__ = ["FIXED", "LIVE", "TOPICS", "Declared", "options_of", "settings_of"]

TOPICS = ("points", "scan", "image", "sonar_image")
_MAX_DB = 1000.0
_MAX_M = 1000.0


class Declared(NamedTuple):
    """Default of a parameter, its meaning, and the limits of a number; empty texts and 0 Hz stand for no value."""

    default: Any
    about: str
    low: float | None = None
    high: float | None = None

    def descriptor(self, *, read_only: bool) -> ParameterDescriptor:
        """Return the descriptor that tools of ROS show."""
        limits = [] if self.low is None else [FloatingPointRange(from_value=self.low, to_value=self.high)]
        return ParameterDescriptor(description=self.about, read_only=read_only, floating_point_range=limits)


FIXED = {
    "source": Declared(
        "tcp://127.0.0.1:5602",
        "Address of a central node, a recording, an image file, or ports; spaces separate ports, quote others.",
    ),
    "sensors": Declared([""], "Sensors to publish; all by default."),
    "topics": Declared(["points", "scan"], f"Topics of each sensor: {', '.join(TOPICS)}."),
    "odometry": Declared(default=False, about="Publish the motion of the platform on odom and /tf."),
    "alone": Declared(default=False, about="For odometry: no sensor emits except those given."),
    "interface": Declared("lo", "Network interface of the topics; lo serves this machine only."),
    "reliability": Declared("reliable", "Reliability of the topics of sensors: reliable or best_effort."),
    "mounting": Declared("", "File with the positions of the sensors on their platform."),
    "loop": Declared(default=False, about="Restart a file at its end."),
    "publish_clock": Declared(
        default=False, about="Use the recorded timestamps of a file, and publish them on /clock."
    ),
    "preset": Declared("", "For ports: recording preset."),
    "settings": Declared("", "For ports: settings file."),
    "trigger": Declared("", "For ports: trigger by command or by sync."),
    "trigger_rate": Declared(0.0, "For ports: rate of trigger commands in Hz; 10 by default.", 0.0, 100.0),
    "key": Declared("", "Secret key of this client of a central node."),
    "server_key": Declared("", "Public key of the central node."),
    "device": Declared("auto", "Device to compute on: auto, cpu, cuda or numpy."),
}
"""Parameters that are read once, at the start."""

LIVE = {
    "min_level_db": Declared(-20.0, "Lowest level of points and echoes re the strongest, in dB.", -_MAX_DB, 0.0),
    "floor_dbfs": Declared(-_MAX_DB, "Lowest level of echoes in scans in dBFS; -1000 is none.", -_MAX_DB, _MAX_DB),
    "first_range_m": Declared(0.0, "First range of points and echoes in m.", 0.0, _MAX_M),
    "last_range_m": Declared(_MAX_M, "Last range of points and echoes in m; 1000 is no limit.", 0.0, _MAX_M),
    **{
        f"max_rate_hz.{topic}": Declared(0.0, f"Largest rate of {topic} of each sensor in Hz; 0 is no limit.", 0.0, 1e4)
        for topic in TOPICS
    },
    "paused": Declared(default=False, about="Publish nothing; a file waits."),
    "speed": Declared(1.0, "Speed of a file relative to the recording.", 0.01, 100.0),
}
"""Parameters that may change at any time."""

_SWITCHES = {"publish_clock": "--use-sim-time"}
_LISTS = {"sensors": "--sensor", "topics": "--topic"}


def options_of(values: Mapping[str, Any], namespace: str) -> list[str]:
    """Return the arguments of ``ertis ros`` for values of the fixed parameters."""
    return [*_arguments(values), *(["--namespace", namespace] if namespace else [])]


def _arguments(values: Mapping[str, Any]) -> Iterator[str]:
    for name, value in values.items():
        option = _SWITCHES.get(name, f"--{name.replace('_', '-')}")
        if name == "source":
            yield from shlex.split(value)
        elif name in _LISTS:
            yield from (word for each in value if each for word in (_LISTS[name], each))
        elif isinstance(value, bool):
            yield from [option] * value
        elif value:
            yield from (option, str(value))


def settings_of(values: Mapping[str, Any]) -> PublishingSettings:
    """Return the settings for values of the live parameters; raise ArgumentError if they are invalid."""
    first_m, last_m = values["first_range_m"], values["last_range_m"]
    is_limited = first_m > 0 or last_m < _MAX_M
    rates_hz = {topic: values[f"max_rate_hz.{topic}"] for topic in TOPICS}
    return PublishingSettings(
        min_level_db=values["min_level_db"],
        floor_dbfs=None if values["floor_dbfs"] == -_MAX_DB else values["floor_dbfs"],
        range_m=(first_m, last_m) if is_limited else None,
        max_rate_hz={topic: rate_hz for topic, rate_hz in rates_hz.items() if rate_hz},
        paused=values["paused"],
        speed=values["speed"],
    )
