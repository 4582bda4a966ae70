"""Two hosts and a cable: network namespaces, and a process that carries their packets or loses them.

Each host has a TUN interface, which hands its packets to a program instead of a network card. The program loses,
delays, repeats and reorders packets, and can be unplugged. The hosts use the kernel's own TCP. ``tc netem`` between two
virtual cards would do the same, but not every kernel has it.
"""

import contextlib
import fcntl
import heapq
import os
import random
import secrets
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

__all__ = ["Cable", "Weather", "cable"]

_TUN: Final = Path("/dev/net/tun")
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_MTU: Final = 1500
_QUEUE: Final = 2000  # Maximum number of packets under way. Further packets are lost, as in any switch.


@dataclass(frozen=True, slots=True, kw_only=True)
class Weather:
    """Effects of a cable on packets: shares of lost, repeated and late packets, and the delay of all packets."""

    lose: float = 0.0
    repeat: float = 0.0
    late: float = 0.0
    delay_s: float = 0.0
    late_s: float = 0.05


@dataclass(slots=True)
class Cable:
    """Cable between two hosts.

    Attributes
    ----------
    hosts : (str, str)
        Names of two namespaces. ``ip netns exec NAME`` runs a command in one.
    addresses : (str, str)
        Addresses of the hosts, without a port.
    weather : Weather
        Effects on packets. They may be changed at any time.
    plugged : bool
        False while the cable is unplugged and carries nothing.
    carried, lost : int
        Numbers of packets.
    """

    hosts: tuple[str, str]
    addresses: tuple[str, str]
    weather: Weather = field(default_factory=Weather)
    plugged: bool = True
    carried: int = 0
    lost: int = 0

    def inside(self, end: int, command: list[str]) -> list[str]:
        """Return a command that runs another command in one of the hosts."""
        return ["ip", "netns", "exec", self.hosts[end], *command]

    def _carry(self, ends: tuple[int, int], rng: random.Random, closing: int) -> None:
        """Carry packets until ``closing`` becomes readable."""
        due: list[tuple[float, int, int, bytes]] = []
        number = 0
        while True:
            wait_s = max(0.0, due[0][0] - time.monotonic()) if due else None
            ready, _, _ = select.select([*ends, closing], [], [], wait_s)
            if closing in ready:
                return
            now_s = time.monotonic()
            for end in ready:
                packet = os.read(end, 65_536)
                weather = self.weather
                if not self.plugged or rng.random() < weather.lose or len(due) >= _QUEUE:
                    self.lost += 1
                    continue
                late_s = rng.uniform(0.0, weather.late_s) if rng.random() < weather.late else 0.0
                for _ in range(1 + (rng.random() < weather.repeat)):
                    number += 1
                    heapq.heappush(due, (now_s + weather.delay_s + late_s, number, ends[end == ends[0]], packet))
            while due and due[0][0] <= time.monotonic():
                _, _, sink, packet = heapq.heappop(due)
                self.carried += 1
                with contextlib.suppress(OSError):  # The packet is lost if the host's interface is full.
                    os.write(sink, packet)


@contextmanager
def cable(*, seed: int) -> Iterator[Cable | None]:
    """Yield a cable between two hosts, and remove the hosts afterwards.

    Yield None if this user may not create namespaces.
    """
    token = secrets.token_hex(3)
    made = Cable((f"ertis-{token}-a", f"ertis-{token}-b"), ("10.231.0.1", "10.231.0.2"))
    ends: list[int] = []
    hosts: list[str] = []
    closing, close = os.pipe()
    carrier: threading.Thread | None = None
    try:
        try:
            for number, host in enumerate(made.hosts):
                _ip("netns", "add", host)
                hosts.append(host)
                ends.append(_interface(host, f"ertis{token}{number}", *_turned(made.addresses, number)))
        except (OSError, subprocess.CalledProcessError):
            yield None
            return
        arguments = ((ends[0], ends[1]), random.Random(seed), closing)
        carrier = threading.Thread(target=made._carry, args=arguments, daemon=True)  # noqa: SLF001  it is of here
        carrier.start()
        yield made
    finally:
        os.write(close, b"\0")
        if carrier is not None:
            carrier.join()
        for end in (*ends, closing, close):
            os.close(end)
        for host in hosts:
            _ip("netns", "del", host)


def _turned(addresses: tuple[str, str], number: int) -> tuple[str, str]:
    return addresses if number == 0 else (addresses[1], addresses[0])


def _interface(host: str, name: str, own: str, other: str) -> int:
    """Create an interface of a host, and return the file descriptor that carries its packets."""
    end = os.open(_TUN, os.O_RDWR)
    try:
        fcntl.ioctl(end, _TUNSETIFF, struct.pack("16sH", name.encode(), _IFF_TUN | _IFF_NO_PI))
        _ip("link", "set", name, "netns", host)
        _ip("-n", host, "address", "add", own, "peer", other, "dev", name)
        _ip("-n", host, "link", "set", name, "mtu", str(_MTU), "up")
        _ip("-n", host, "link", "set", "lo", "up")
    except BaseException:
        os.close(end)
        raise
    return end


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
