"""``ertis demo``: run the whole system without hardware."""

import functools
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import click

from ertis_cli import _examples, _supervisor, options

__all__ = ["demo"]

_SCENE: Final = "platform.toml"
_SENSORS: Final = ("front", "left", "back", "right")
_WRITTEN: Final = (
    _SCENE,
    "sensors",
    "recordings",
    "emulate.jsonl",
    "serve.jsonl",
    "heard.jsonl",
    "image.h5",
    "image.png",
)
"""Names of all files and folders that a demo writes."""

_NODE: Final = (sys.executable, "-m", "ertis_cli")
_ANY_PORT: Final = "tcp://127.0.0.1:0"
_LOOK_INTERVAL_S: Final = 0.1
_STATUS_INTERVAL_S: Final = 0.5
_STATUS_TIMEOUT_S: Final = 60.0
_END_TIMEOUT_S: Final = 10.0
_GAPS: Final = 3
"""Exit code of ``ertis verify`` for a recording with gaps."""


@click.command()
@click.option(
    "--output",
    "-o",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    default="demo",
    show_default=True,
    metavar="DIR",
    help="Folder to write to.",
)
@click.option(
    "-n",
    "--count",
    type=click.IntRange(min=1),
    default=50,
    show_default=True,
    metavar="N",
    help="Number of SYNC pulses.",
)
@click.option("--force", is_flag=True, help="Replace the files of an earlier demo.")
@options.quiet
def demo(*, folder: Path, count: int, force: bool, quiet: bool) -> None:
    """Run four emulated sensors, a central node and an application.

    A sensor node sends the measurements of four sensors on one SYNC chain to a central node, which stores them and
    publishes images to an application. The images of all sensors are then fused into one, with a list of
    reflectors and a picture. The demo prints each command and writes all files to one folder.
    """
    from ertis_numba import kernels
    from ertis_numba.devices.links import require_terminals

    require_terminals()
    kernels.require_numba("'ertis demo', which renders 120 measurements,")
    _make(folder, force=force)
    scene = folder / _SCENE
    (item,) = _examples.named(_SCENE).values()
    scene.write_bytes(item.read_bytes())
    sensors = {"ERTIS_EMULATED_DIR": str((folder / "sensors").absolute())}  # links to the emulated sensors
    run = _DemoRun(os.environ | sensors, quiet=quiet)
    ports = [word for name in _SENSORS for word in ("--port", name)]
    with ExitStack() as nodes:
        emulating = ("sensors", "emulate", scene, "--sync-rate", "10", "--json")  # its progress is shown
        nodes.enter_context(run.node(*emulating, output=folder / "emulate.jsonl"))
        serving = ("serve", "--listen", _ANY_PORT, "--publish", _ANY_PORT, "--record", folder / "recordings")
        central = nodes.enter_context(run.node(*serving, "--json", "--quiet", output=folder / "serve.jsonl"))
        options.say("waiting for the workers of the central node ...", quiet=quiet)
        _await_worker(central["address"])
        listening = ("listen", central["publish"], "--json", "--quiet")
        nodes.enter_context(run.node(*listening, output=folder / "heard.jsonl"))
        run("sensors", "list")
        to = ("--trigger", "sync", "-n", str(count), "--to", central["address"], "--mounting", scene)
        run("capture", *ports, *to)
        run("sensors", "status", central["address"], "--once")
    image = folder / "image.h5"
    recordings = sorted((folder / "recordings").glob("*.h5"))
    run("verify", *recordings, allowed=(_GAPS,))  # a busy machine may miss a pulse
    run("fuse", recordings[0], "--output", image, "--directions", "2d:181")
    run("peaks", image, "--measurement", "0")
    run("plot", image, "--output", folder / "image.png")


def _make(folder: Path, *, force: bool) -> None:
    """Make the folder, and remove the files of an earlier demo."""
    from ertis_numba.base.errors import ArgumentError

    there = [folder / name for name in _WRITTEN if (folder / name).exists() or (folder / name).is_symlink()]
    if there and not force:
        raise ArgumentError(f"output {there[0]} exists; choose another folder (--output), or overwrite it (--force)")
    for path in there:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    folder.mkdir(parents=True, exist_ok=True)


def _await_worker(address: str) -> None:
    """Wait until the central node can process measurements."""
    from ertis_numba.network.central_client import CentralClient

    with CentralClient(address) as node:
        while True:
            processing = node.status(_STATUS_TIMEOUT_S).processing
            if processing is not None and any(worker.state == "idle" for worker in processing.workers):
                return
            time.sleep(_STATUS_INTERVAL_S)


class _DemoRun:
    """Runner of ``ertis`` commands, each in a process of its own."""

    def __init__(self, environment: Mapping[str, str], *, quiet: bool) -> None:
        self._environment, self._quiet = environment, quiet
        self._nodes: list[subprocess.Popen[bytes]] = []
        # No node outlives this process, even if it is killed.
        ends = functools.partial(_supervisor.end_with, os.getpid(), signal.SIGTERM)
        self._bind = ends if sys.platform == "linux" else None

    def __call__(self, *words: object, allowed: Sequence[int] = ()) -> None:
        """Run a command to its end; raise ClickException if it fails."""
        typed = self._printed(words)
        command = [*_NODE, *map(str, words)]
        done = subprocess.run(command, env=self._environment, preexec_fn=self._bind, check=False)  # noqa: S603
        if done.returncode not in {0, *allowed}:
            raise click.ClickException(f"'{typed}' ended with exit code {done.returncode}; its error is above")

    @contextmanager
    def node(self, *words: object, output: Path) -> Iterator[dict[str, Any]]:
        """Run a command until the block ends; yield its first object; raise ClickException if it ends before."""
        typed = self._printed(words)
        with output.open("wb") as file:
            # This is a command as a user types it, with its output in a file, rather than a `processes.Child`.
            process = subprocess.Popen(  # noqa: S603
                [*_NODE, *map(str, words)],
                env=self._environment,
                stdout=file,
                preexec_fn=self._bind,  # noqa: PLW1509
            )
        self._nodes.append(process)
        try:
            while not (text := output.read_text("utf-8")).endswith("\n"):
                if process.poll() is not None:
                    raise click.ClickException(
                        f"'{typed}' ended with exit code {process.returncode}; its error is above"
                    )
                time.sleep(_LOOK_INTERVAL_S)
            yield json.loads(text.partition("\n")[0])
        except (KeyboardInterrupt, SystemExit):
            for each in self._nodes:  # All end at the same time, because the user waits.
                each.terminate()
            raise
        finally:
            process.terminate()
            try:
                process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _printed(self, words: Sequence[object]) -> str:
        typed = shlex.join(["ertis", *map(str, words)])
        options.say(f"$ {typed}", quiet=self._quiet)
        return typed
