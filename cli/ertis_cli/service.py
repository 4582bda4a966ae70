"""``ertis sensors service``: systemd units for the nodes of a network."""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Final

import click

from ertis_cli import options

__all__ = ["service", "udev_rule"]

_UNITS: Final = Path("/etc/systemd/system")
_RULES: Final = Path("/etc/udev/rules.d")
_NODES: Final = ("capture", "serve", "record", "ros")
_DEVICES: Final = {"capture": "char-ttyACM char-ttyUSB", "ros": "char-ttyACM char-ttyUSB", "serve": "char-nvidia*"}
"""Groups of /proc/devices that a node may use; no node needs other devices than these."""

_UNIT: Final = Template("""\
[Unit]
Description=ertis $node
Wants=network-online.target
After=network-online.target
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=all
ExecStart=$command
User=$user
WorkingDirectory=$folder
ReadWritePaths=$folder
CacheDirectory=ertis
Environment=NUMBA_CACHE_DIR=%C/ertis
Restart=on-failure
RestartSec=2
# Wrong usage remains wrong; 143 is the exit code of a node that SIGTERM has ended in time.
RestartPreventExitStatus=2
SuccessExitStatus=143
# A first start compiles kernels. Afterwards, the node reports every few seconds that its loop runs.
TimeoutStartSec=600
WatchdogSec=60
TimeoutStopSec=120
KillMode=mixed
SyslogIdentifier=ertis-$node
LogExtraFields=ERTIS_NODE=$node
UMask=0027
$devices
CapabilityBoundingSet=
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
RemoveIPC=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM

[Install]
WantedBy=multi-user.target
""")
_ACCESS: Final = 'GROUP="dialout", MODE="0660"'


@click.command(context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False})
@click.argument("node", type=click.Choice(_NODES))
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
@click.option("--user", metavar="NAME", help="User that runs the node; the one who calls sudo by default.")
@click.option("--uninstall", is_flag=True, help="Stop the service of NODE, and remove its files.")
@click.option("--dry-run", is_flag=True, help="Print the files instead of writing them.")
def service(*, node: str, arguments: tuple[str, ...], user: str | None, uninstall: bool, dry_run: bool) -> None:
    """Install a node as a service of systemd, which starts it at boot.

    ARGUMENTS are those of 'ertis NODE'. The node runs in the present folder, and can write to no other one. systemd
    restarts it after a failure, or if its loop stands still for a minute. For sensors given by serial number, a udev
    rule keeps ModemManager away and links /dev/ertis/SERIAL. Write options of this command before NODE.
    """
    unit, rules = _UNITS / f"ertis-{node}.service", _RULES / f"65-ertis-{node}.rules"
    if uninstall:
        _require_root()
        _call("systemctl", "disable", "--now", unit.name)
        unit.unlink(missing_ok=True)
        rules.unlink(missing_ok=True)
        _reload()
        options.say(f"{unit.name}: removed", quiet=False)
        return
    context = _checked(node, arguments)
    user = user or os.environ.get("SUDO_USER") or Path.home().owner()
    devices = [f"DeviceAllow={each} rw" for each in _DEVICES.get(node, "").split()]
    files = {
        unit: _UNIT.substitute(
            node=node,
            command=" ".join(map(_quoted, (sys.executable, "-P", "-m", "ertis_cli", node, *arguments))),
            user=user,
            folder=str(Path.cwd()).replace("%", "%%"),
            devices="\n".join(["DevicePolicy=closed", *devices]),
        )
    }
    serials = _serial_numbers([*(context.params.get("ports") or ()), *(context.params.get("sources") or ())])
    if serials:
        files[rules] = "".join(f"{udev_rule(each)}\n" for each in serials)
    if dry_run:
        for path, text in files.items():
            click.echo(f"# {path}\n{text}")
        return
    _require_root()
    for path, text in files.items():
        path.write_text(text, "utf-8")
        options.say(f"{path}: written", quiet=False)
    _reload()
    _call("systemctl", "enable", "--now", unit.name)
    options.say(f"{unit.name}: started; its log: journalctl -u {unit.name}", quiet=False)


def udev_rule(serial: str) -> str:
    """Return the udev rule for the port of a sensor, or for all ports of its kind if its serial number is empty."""
    if not serial:
        return f'SUBSYSTEM=="tty", KERNEL=="ttyACM*", {_ACCESS}'
    return (
        f'SUBSYSTEM=="tty", ENV{{ID_SERIAL_SHORT}}=="{serial}", SYMLINK+="ertis/{serial}", {_ACCESS}, '
        'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"'
    )


def _checked(node: str, arguments: Sequence[str]) -> click.Context:
    """Return the context of the node's command; raise a usage error if it refuses the arguments."""
    root = click.get_current_context().find_root()
    command = root.command.get_command(root, node) if isinstance(root.command, click.Group) else None
    assert command is not None  # noqa: S101  `_NODES` are commands
    return command.make_context(node, list(arguments), parent=root)


def _quoted(word: str) -> str:
    """Return a word for ExecStart; see systemd.service(5)."""
    if "\n" in word:
        raise click.UsageError(f"{word!r} contains a line break, which units of systemd cannot contain; remove it")
    for before, after in (("\\", "\\\\"), ('"', '\\"'), ("%", "%%"), ("$", "$$")):
        word = word.replace(before, after)
    return f'"{word}"' if not word or not word.replace("/", "").replace("-", "").replace("_", "").isalnum() else word


def _serial_numbers(names: Sequence[object]) -> list[str]:
    """Return the serial numbers of the sensors among ports, which may be absent now."""
    from ertis_numba.devices.ports import find_ports

    known = {name: port for port in find_ports() for name in port.names}
    found = []
    for name in map(str, names):
        port = known.get(name)
        serial = (
            name if port is None and "/" not in name else "" if port is None or port.emulated else port.serial_number
        )
        if serial.replace("-", "").replace("_", "").isalnum():
            found.append(serial)
    return found


def _require_root() -> None:
    for folder in (_UNITS, _RULES):
        if not folder.is_dir():
            raise click.ClickException(f"{folder} does not exist; use a Linux system that runs systemd")
        if not os.access(folder, os.W_OK):
            program = shutil.which("ertis") or "ertis"
            raise click.ClickException(f"{folder} cannot be written; run 'sudo {program} sensors service ...'")


def _reload() -> None:
    _call("systemctl", "daemon-reload")
    _call("udevadm", "control", "--reload")
    _call("udevadm", "trigger", "--subsystem-match=tty")


def _call(*command: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  fixed programs
    except FileNotFoundError as error:
        raise click.ClickException(f"{command[0]} is missing; use a Linux system that runs systemd") from error
    if done.returncode:
        raise click.ClickException(f"'{' '.join(command)}' failed: {' '.join(done.stderr.split())}")
