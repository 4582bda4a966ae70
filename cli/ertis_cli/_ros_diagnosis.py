"""Checks of `ertis doctor --ros`: the usual reasons why ROS 2 programs receive nothing."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ertis_cli import options
from ertis_cli._diagnosis import InstallationFinding

__all__ = ["ros_findings"]

_MULTICAST: Final = 0x1000
_UP: Final = 0x1
_CONTAINER: Final = Path("/.dockerenv")
_CLASSES: Final = Path("/sys/class/net")


def ros_findings(domain: int | None, interface: str) -> Iterator[InstallationFinding]:
    """Yield findings about packages, environment, interface, and other programs in the domain."""
    from ertis_numba.base.errors import ArgumentError, DeviceError
    from ertis_numba.ros import Participant
    from ertis_numba.ros.discovery import discover

    yield from _environment()
    yield from _interface(interface)
    try:
        participant = Participant(domain=domain, interface=interface)
    except (ArgumentError, DeviceError) as error:
        fault, _, remedy = str(error).partition("; ")
        yield InstallationFinding("ROS domain", "bad", fault, remedy)
        return
    with participant:
        number = participant.domain
        origin = "given" if domain is not None else "ROS_DOMAIN_ID" if os.environ.get("ROS_DOMAIN_ID") else "by default"
        yield InstallationFinding("ROS domain", "good", f"{number} ({origin}) on {interface}; others must use the same")
        n_others, subscribers = discover(participant)
    first = 7400 + 250 * number
    yield InstallationFinding(
        "ROS programs",
        "good" if n_others else "note",
        f"{options.counted(n_others, 'other participant')} in domain {number} on {interface}",
        ""
        if n_others
        else "start one; compare ROS_DOMAIN_ID and the interface; in the firewall, allow UDP ports "
        f"{first} to {first + 249} and multicast to 239.255.0.1",
    )
    for each in subscribers:
        reliability = (
            "reliable: it receives nothing from --reliability best_effort" if each.is_reliable else "best effort"
        )
        yield InstallationFinding("ROS subscriber", "good", f"{each.topic}  {each.message}, {reliability}")
    if n_others and not subscribers:
        yield InstallationFinding(
            "ROS subscriber", "note", "none in this domain", "subscribe first, because topics keep no old messages"
        )


def _environment() -> Iterator[InstallationFinding]:
    """Yield findings about variables of ROS that prevent exchange with DDS."""
    middleware = os.environ.get("RMW_IMPLEMENTATION", "")
    if "zenoh" in middleware:
        yield InstallationFinding(
            "ROS middleware", "bad", f"RMW_IMPLEMENTATION is {middleware}, which is not DDS", "use rmw_fastrtps_cpp"
        )
    server = os.environ.get("ROS_DISCOVERY_SERVER", "")
    if server:
        yield InstallationFinding(
            "ROS discovery",
            "bad",
            f"ROS_DISCOVERY_SERVER is {server}; programs then find only those that use this server",
            "unset it for the programs that receive topics",
        )
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach == "OFF":
        yield InstallationFinding(
            "ROS discovery", "bad", "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF", "set it to LOCALHOST or SUBNET"
        )


def _interface(name: str) -> Iterator[InstallationFinding]:
    """Yield findings about the network interface; nothing on systems without /sys."""
    if _CONTAINER.exists():
        yield InstallationFinding(
            "ROS container", "note", "this is a container", "use the network of the host (docker run --network host)"
        )
    try:
        flags = int((_CLASSES / name / "flags").read_text(), 16)
    except (OSError, ValueError):
        return
    if not flags & _UP:
        yield InstallationFinding(
            "ROS interface", "bad", f"{name} is down", f"run 'ip link set {name} up', or use another"
        )
    elif not flags & _MULTICAST and name != "lo":
        yield InstallationFinding(
            "ROS interface",
            "bad",
            f"{name} has no multicast, which programs need to find each other",
            f"run 'ip link set {name} multicast on', or use another",
        )
