"""``ertis ros``: images and points as live ROS 2 topics."""

import math
import sys
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ertis_cli import _mountings, _network, _ros_sources, _watchdog, options
from ertis_cli._recording_settings import recording_settings, settings_from
from ertis_cli._ros_report import RosReport
from ertis_cli._stop_signals import stopped_by_signals

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ertis_numba.ros import RosPublisher
    from ertis_numba.ros.publishing_settings import PublishingSettings, WatchedSettings

__all__ = ["ros"]

_TOPICS = ("points", "scan", "image", "sonar_image")
_KINDS = {"address": "an address", "file": "a file", "port": "ports"}
_TRIGGER_RATE_HZ = 10.0
_CONTROL_INTERVAL_S = 0.1


class _MaxRate(click.ParamType[Any]):
    """Option TOPIC=HZ."""

    name = "topic=hz"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        topic, _, rate = str(value).partition("=")
        try:
            rate_hz = float(rate)
        except ValueError:
            rate_hz = math.nan
        if topic not in _TOPICS or not rate_hz > 0:
            self.fail(f"{value!r} is not TOPIC=HZ, as in image=5; topics are {', '.join(_TOPICS)}", param, ctx)
        return topic, rate_hz


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="ADDRESS|REC.h5|IMG.h5|PORT...")
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    metavar="NAME",
    help="Publish this sensor only; repeatable; all sensors by default.",
)
@click.option(
    "--topic",
    "topics",
    type=click.Choice(_TOPICS),
    multiple=True,
    help="Topic to publish for each sensor; repeatable; points and scan by default.",
)
@click.option(
    "--odometry",
    is_flag=True,
    help="Publish the pose and velocity of the platform on odom, and its transform on /tf.",
)
@options.alone
@click.option("--namespace", default="", metavar="NAME", help="Prefix of the topics of sensors, such as robot1.")
@click.option(
    "--domain",
    type=int,
    metavar="N",
    help="DDS domain, 0 to 232; the value of ROS_DOMAIN_ID by default, or 0 without it.",
)
@click.option(
    "--interface",
    default="lo",
    show_default=True,
    metavar="NAME",
    help="Network interface. Everyone on its network can read the topics; lo serves this machine only.",
)
@click.option(
    "--reliability",
    type=click.Choice(["reliable", "best_effort"]),
    default="reliable",
    show_default=True,
    help="Reliability of the topics of sensors; best_effort never sends a lost message again.",
)
@click.option(
    "--max-rate",
    "max_rates",
    type=_MaxRate(),
    multiple=True,
    metavar="TOPIC=HZ",
    help="Largest rate of a topic of each sensor, as in image=5; repeatable.",
)
@click.option(
    "--min-level",
    type=float,
    default=-20.0,
    show_default=True,
    metavar="DB",
    help="Lowest level of points and echoes, relative to the strongest of the image.",
)
@click.option(
    "--floor",
    "floor_dbfs",
    type=float,
    metavar="DBFS",
    help="Lowest absolute level of echoes in scans; without it, noise counts as an echo in images without echoes.",
)
@click.option(
    "--use-sim-time",
    "sim_time",
    is_flag=True,
    help="Use the recorded timestamps instead of the current time, and publish them on /clock.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.01, 100),
    default=1.0,
    show_default=True,
    metavar="X",
    help="Speed of playback relative to real time; 1 by default.",
)
@click.option(
    "--control",
    type=options.FILE,
    metavar="FILE",
    help="TOML file that sets levels, ranges, rates and speed, or pauses; read again whenever it changes.",
)
@click.option("--loop", is_flag=True, help="Restart a file at its end.")
@click.option(
    "--trigger",
    type=click.Choice(["command", "sync"]),
    help="With ports: trigger by commands of this program (the default), or by pulses of the SYNC chain.",
)
@click.option(
    "--trigger-rate",
    "trigger_rate_hz",
    type=click.FloatRange(0.1, 100),
    metavar="HZ",
    help="With ports: rate of trigger commands; 10 by default.",
)
@recording_settings
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@_mountings.mounting
@_network.key
@_network.server_key
@options.device
@options.quiet
@options.as_json_of("one object per line for each event; the last one is a summary")
def ros(
    *,
    sources: tuple[str, ...],
    sensors: tuple[str, ...],
    topics: tuple[str, ...],
    odometry: bool,
    alone: bool,
    namespace: str,
    domain: int | None,
    interface: str,
    reliability: Any,
    max_rates: tuple[tuple[str, float], ...],
    min_level: float,
    floor_dbfs: float | None,
    sim_time: bool,
    rate: float,
    control: Path | None,
    loop: bool,
    trigger: str | None,
    trigger_rate_hz: float | None,
    duration: float | None,
    mounting: Path | None,
    key: str | None,
    server_key: str | None,
    device: Any,
    quiet: bool,
    as_json: bool,
    **given_settings: Any,
) -> None:
    """Publish images and points as live ROS 2 topics.

    ROS need not be installed, but the command needs the extra 'ros'. ADDRESS is the address at which a central node
    publishes. Files are published at their original speed; a recording is processed with its own settings. The sensor
    at each PORT measures as with 'ertis capture', but no measurement is stored. DDS, the middleware of ROS 2, has no
    passwords. By default, only this machine can read the topics; --interface opens them to a network.

    With --odometry, all sensors with a known mounting belong to one platform. Its path starts at the origin of the
    frame odom.
    """
    kind = _kind(sources)
    source = " ".join(sources)
    of_files = {"--use-sim-time": sim_time, "--loop": loop, "--rate": rate != 1.0}
    of_ports = {"--trigger": trigger, "--trigger-rate": trigger_rate_hz}
    of_ports |= {f"--{name.removesuffix('_file')}": value for name, value in given_settings.items()}
    _require_fitting(kind, sensors, {"file": of_files, "port": of_ports})
    _network.require_duration(duration)
    chosen = topics or ("points", "scan")
    own: dict[str, Any]  # The options of this kind of source.
    if kind == "port":
        own = {"settings": settings_from(**given_settings), "trigger": trigger or "command", "device": device}
        own |= {"rate_hz": trigger_rate_hz or _TRIGGER_RATE_HZ, "quiet": quiet}
    elif kind == "address":
        own = {"sensors": sensors, "images": odometry or set(chosen) != {"points"}, "keys": (key, server_key)}
    else:
        own = {"sensors": sensors, "device": device, "loop": loop, "sim_time": sim_time}
    watched, publishing = _publishing(
        control, min_level_db=min_level, floor_dbfs=floor_dbfs, max_rate_hz=dict(max_rates), speed=rate
    )
    from ertis_numba.ros import Participant, RosPublisher

    end_s = math.inf if duration is None else time.monotonic() + duration
    given = _mountings.mountings(mounting, sensors or None) or {}
    notes: deque[str] = deque()
    with (
        stopped_by_signals() as signals,
        Participant(domain=domain, interface=interface, reliability=reliability) as participant,
        RosPublisher(
            participant,
            topics=chosen,
            namespace=namespace,
            mounting=given,
            settings=publishing,
            odometry=odometry,
            alone=alone or None,
            on_note=notes.append,
        ) as publisher,
    ):
        report = RosReport(publisher, notes, quiet=quiet, as_json=as_json)

        def is_over() -> bool:
            _watchdog.beat()
            report.show_notes()
            if watched is not None:
                watched.poll(publisher, report.note)
            return bool(signals.came) or time.monotonic() >= end_s

        own |= {
            "is_over": is_over,
            "on_ready": lambda: report.start(source, participant),
            "on_published": report.published,
            "signals": signals,
        }
        _publish(kind, sources, publisher, report, **own)
        publisher.close()
        report.end()
        if signals.came and kind == "file" and not loop:
            sys.exit(128 + signals.came[0])


def _publish(kind: str, sources: tuple[str, ...], publisher: "RosPublisher", report: RosReport, **own: Any) -> None:
    """Publish from sensors at ports, from a central node or from a file, with the options of that source."""
    if kind == "port":
        _ros_sources.publish_ports(sources, publisher, on_note=report.note, **own)
    elif kind == "address":
        keys = _network.client_keys(*own.pop("keys"))
        _ros_sources.publish_node(sources[0], publisher, keys=keys, on_note=report.note, **own)
    else:
        _ros_sources.publish_file(Path(sources[0]), publisher, on_passive=report.passive, **own)


def _require_fitting(kind: str, sensors: tuple[str, ...], given: "Mapping[str, Mapping[str, object]]") -> None:
    """Raise an error for given options of another kind of source."""
    for wanted, options_of in given.items():
        for name, value in options_of.items():
            if kind != wanted and value not in {None, False}:
                raise click.UsageError(f"{name} is for {wanted}s; remove it with {_KINDS[kind]}")
    if kind == "port" and sensors:
        raise click.UsageError(
            "--sensor selects sensors of a file or an address; name the ports of the sensors instead"
        )


class _Control:
    """Control file that is checked for changes at regular intervals."""

    def __init__(self, watched: "WatchedSettings") -> None:
        self._watched, self._next_s = watched, 0.0

    def poll(self, publisher: "RosPublisher", note: "Callable[[str], None]") -> None:
        """Use new settings, or report why they cannot be used."""
        from ertis_numba.base.errors import SettingsError

        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + _CONTROL_INTERVAL_S
        try:
            changed = self._watched.changed()
        except SettingsError as error:
            note(f"{error}; the former settings stay in use")
            return
        if changed is not None:
            publisher.settings = changed
            note("new settings are in use")


def _publishing(control: Path | None, **given: Any) -> "tuple[_Control | None, PublishingSettings]":
    """Return the control file and its settings, or those of the options."""
    from ertis_numba.ros.publishing_settings import PublishingSettings, WatchedSettings

    if control is None:
        return None, PublishingSettings(**given)
    context = click.get_current_context()
    for name in ("min_level", "floor_dbfs", "max_rates", "rate"):
        if context.get_parameter_source(name) not in {ParameterSource.DEFAULT, None}:
            option = next(each for each in context.command.params if each.name == name).opts[0]
            raise click.UsageError(f"{option} and --control cannot be combined; set the value in the file")
    watched = WatchedSettings(control)
    return _Control(watched), watched.settings


def _kind(sources: tuple[str, ...]) -> str:
    """Return the kind of the sources: address, file or port."""
    kinds = {"address" if "://" in each else "file" if Path(each).is_file() else "port" for each in sources}
    kind = kinds.pop()
    if kinds or (kind != "port" and len(sources) > 1):
        raise click.UsageError(
            "several sources are given, but only ports can be combined; use one address, one file, or ports"
        )
    if kind == "port" and any(Path(each).suffix == ".h5" for each in sources):
        raise click.UsageError(f"file {sources[0]} does not exist; choose an existing file, an address, or ports")
    return kind
