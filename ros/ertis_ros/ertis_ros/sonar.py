"""Node that publishes the images of sensors, as ``ertis ros`` does, with parameters in place of options.

The command publishes with a DDS participant of its own. The node offers the parameters, and writes those that may
change to the control file of the command.
"""

import contextlib
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import rclpy
from ertis_cli.main import cli
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from ertis_numba.base.errors import ErtisError
from ertis_ros.parameters import FIXED, LIVE, options_of, settings_of

__all__ = ["Sonar", "main"]


class Sonar(Node):
    """Node with the parameters of ``ertis ros``."""

    def __init__(self, control: Path) -> None:
        super().__init__("sonar")
        self._control = control
        for name, each in FIXED.items():
            self.declare_parameter(name, each.default, each.descriptor(read_only=True))
        for name, each in LIVE.items():
            self.declare_parameter(name, each.default, each.descriptor(read_only=False))
        self._write(self._values(LIVE))
        self.add_on_set_parameters_callback(self._change)

    @property
    def arguments(self) -> list[str]:
        """Arguments of ``ertis ros``."""
        given = options_of(self._values(FIXED), self.get_namespace().strip("/"))
        return [*given, "--control", str(self._control)]

    def _values(self, declared: dict[str, Any]) -> dict[str, Any]:
        return {name: self.get_parameter(name).value for name in declared}

    def _change(self, changed: list[Parameter]) -> SetParametersResult:
        """Use new values together, or refuse them with the reason."""
        new = {each.name: each.value for each in changed if each.name in LIVE}
        try:
            self._write(self._values(LIVE) | new)
        except (ErtisError, OSError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _write(self, values: dict[str, Any]) -> None:
        part = self._control.with_suffix(".part")
        part.write_text(settings_of(values).to_toml(), "utf-8")
        part.replace(self._control)


def _spin(node: Node) -> None:
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def main() -> None:
    """Run the node until its source ends or a signal comes."""
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)  # The command handles signals.
    with tempfile.TemporaryDirectory(prefix="ertis_ros_") as folder:
        try:
            node = Sonar(Path(folder) / "control.toml")
        except (ErtisError, ParameterException) as error:
            sys.exit(f"ertis_ros: {error}")
        spinning = threading.Thread(target=_spin, args=(node,), daemon=True)
        spinning.start()
        try:
            cli.main(["ros", *node.arguments], prog_name="ertis")
        finally:
            rclpy.shutdown()
            spinning.join()


if __name__ == "__main__":
    main()
