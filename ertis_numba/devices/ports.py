"""Serial ports, and the selection of one by name."""

import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from serial.tools import list_ports

from ertis_numba.devices.line import sonar_error
from ertis_numba.devices.links import emulated_folder, is_held

__all__ = ["Port", "find_again", "find_ports", "resolve"]

_BY_ID = Path("/dev/serial/by-id")
_CDC_ACM = ("ttyACM", "cu.usbmodem", "tty.usbmodem", "COM")


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """A serial port."""

    path: str  # may change when the device is plugged in again
    link: str = ""  # stable name, such as one in /dev/serial/by-id; empty if there is none
    serial_number: str = ""  # of the USB device, or name of an emulated one; empty if unknown
    description: str = ""
    emulated: bool = False

    def __str__(self) -> str:
        known = self.serial_number or self.description
        return f"{self.path} ({known})" if known else self.path

    @property
    def may_be_sonar(self) -> bool:
        """True for the kind of port of an eRTIS, which may be probed without a request."""
        return self.emulated or Path(self.path).name.startswith(_CDC_ACM)

    @property
    def names(self) -> set[str]:
        """Names that select it."""
        given = (self.path, self.link, Path(self.path).name, Path(self.link).name, self.serial_number)
        return {name for name in given if name}


def find_ports() -> list[Port]:
    """Return the serial ports of USB devices, then those of running emulated devices."""
    return [*_usb_ports(), *_emulated_ports()]


def resolve(port: str) -> Port:
    """Return the port of a path, link, serial number or emulated name; raise SonarError (ENOENT; EINVAL: several)."""
    found = find_ports()
    named = [item for item in found if port in item.names]
    if len({item.path for item in named}) > 1:
        raise sonar_error(
            f"{port!r} matches {len(named)} ports: {_listed(named)}; choose the path of one", errno.EINVAL
        )
    if named:
        return named[0]
    path = os.path.realpath(port)
    if Path(path).exists() and is_held(Path(port)):
        link = os.path.abspath(port) if Path(port).is_symlink() else ""  # noqa: PTH100  which follows no link
        same = [item for item in found if item.path == path]
        return replace(same[0], link=link or same[0].link) if same else Port(path=path, link=link)
    if any(info.device == port for info in list_ports.comports()):  # Not a USB port and not a file, as on Windows.
        return Port(path=port)
    there_are = (
        f"choose one of {_listed(found)}"
        if found
        else "no port exists: check the cable, or start an emulated one with 'ertis sensors emulate'"
    )
    raise sonar_error(f"serial port {port!r} does not exist; {there_are}", errno.ENOENT)


def find_again(port: Port) -> Port:
    """Return the port of a device that was plugged in again, by serial number, link or path, as `resolve`."""
    if port.serial_number and not port.emulated:
        return replace(resolve(port.serial_number), link=port.link)
    return resolve(port.link or port.path)


def _listed(found: list[Port]) -> str:
    return ", ".join(str(item) for item in found)


def _usb_ports() -> Iterator[Port]:
    links = {os.path.realpath(link): str(link) for link in sorted(_BY_ID.iterdir())} if _BY_ID.is_dir() else {}
    for info in sorted(list_ports.comports(), key=lambda info: info.device):
        if info.vid is not None:
            yield Port(
                path=info.device,
                link=links.get(info.device, ""),
                serial_number=info.serial_number or "",
                description=info.description or "",
            )


def _emulated_ports() -> Iterator[Port]:
    folder = emulated_folder()
    for link in sorted(folder.iterdir()) if folder.is_dir() else ():
        path = os.path.realpath(link)
        if link.is_symlink() and not link.name.startswith(".") and Path(path).exists() and is_held(link):
            yield Port(path=path, link=str(link), serial_number=link.name, description="emulated eRTIS", emulated=True)
