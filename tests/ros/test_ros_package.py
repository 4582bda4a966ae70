"""The ROS 2 package: its manifest, its build, its launch files, and its node."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import types
import xml.etree.ElementTree as ET
import zipfile
from contextlib import contextmanager
from importlib import metadata

import pytest

from tests.journals import ENVIRONMENT
from tests.pages import ROOT
from tests.ros_topics import OTHER_DOMAIN, WAIT_S

PACKAGE = ROOT / "ros" / "ertis_ros"
LAUNCH = PACKAGE / "launch"
ONCE, ANY = (1, 1), (0, 1000)
MANIFEST = {
    "name": ONCE,
    "version": ONCE,
    "description": ONCE,
    "maintainer": (1, 1000),
    "license": (1, 1000),
    "url": ANY,
    "author": ANY,
    "exec_depend": ANY,
    "build_depend": ANY,
    "test_depend": ANY,
    "export": (0, 1),
}
"""Elements of package format 3 (REP 149) that the manifest may use, with their numbers."""


def test_manifest_follows_package_format_3():
    root = ET.parse(PACKAGE / "package.xml").getroot()
    assert (root.tag, root.get("format")) == ("package", "3")
    tags = [each.tag for each in root]
    for tag, (least, most) in MANIFEST.items():
        assert least <= tags.count(tag) <= most, tag
    assert {*tags} <= {*MANIFEST}
    assert re.fullmatch(r"[a-z][a-z0-9_]*[a-z0-9]", root.findtext("name"))
    assert re.fullmatch(r"\d+\.\d+\.\d+", root.findtext("version"))
    assert re.fullmatch(r"[^@\s]+@[^@\s]+\.\w+", root.find("maintainer").get("email"))
    assert root.findtext("export/build_type") == "ament_python"
    depends = [each.text for each in root.iter("exec_depend")]
    assert depends == sorted({*depends})


def test_versions_are_those_of_the_package():
    version = metadata.version("ertis-numba")
    assert ET.parse(PACKAGE / "package.xml").findtext("version") == version
    assert f'version="{version}"' in (PACKAGE / "setup.py").read_text("utf-8")


def test_build_contains_marker_launch_files_and_node(tmp_path):
    copy = shutil.copytree(PACKAGE, tmp_path / "ertis_ros")  # The build writes into its folder.
    command = [sys.executable, "setup.py", "--quiet", "bdist_wheel", "--dist-dir", str(tmp_path)]
    subprocess.run(command, cwd=copy, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as built:
        files = {name.partition(".data/data/")[2] or name: name for name in built.namelist()}
        assert "share/ament_index/resource_index/packages/ertis_ros" in files
        assert "share/ertis_ros/package.xml" in files
        for path in LAUNCH.iterdir():
            assert built.read(files[f"share/ertis_ros/launch/{path.name}"]) == path.read_bytes()
        (entry,) = (name for name in files if name.endswith("entry_points.txt"))
        assert b"sonar = ertis_ros.sonar:main" in built.read(entry)


def test_files_for_nav2_and_rviz_stand_once():
    for name in ("nav2.launch.py", "nav2.rviz", "nav2.yaml", "ertis.rviz"):
        assert (LAUNCH / name).resolve() == ROOT / "examples" / name


@pytest.fixture
def launch_stub(monkeypatch):
    """Modules in place of ROS's launch, which is not on PyPI; objects record their arguments."""

    class Recorded:
        def __init__(self, *args, **kwargs):
            self.args, self.kwargs = args, kwargs

    def module(name, *names):
        made = types.ModuleType(name)
        for each in names:
            setattr(made, each, type(each, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, made)

    module("launch", "LaunchDescription")
    module("launch.actions", "DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription")
    module("launch.conditions", "IfCondition")
    module("launch.substitutions", "LaunchConfiguration")
    module("launch_ros", "Recorded")
    module("launch_ros.actions", "Node")
    module("launch_ros.parameter_descriptions", "ParameterValue")


@pytest.mark.usefixtures("launch_stub")
@pytest.mark.parametrize("name", ["sensor", "platform", "replay"])
def test_launch_file_sets_parameters_that_the_node_declares(name, parameters):
    path = LAUNCH / f"{name}.launch.py"
    made = {"__file__": str(path)}
    exec(compile(path.read_text("utf-8"), path, "exec"), made)
    (actions,) = made["generate_launch_description"]().args
    declared = {each.args[0] for each in actions if type(each).__name__ == "DeclareLaunchArgument"}
    nodes = [each.kwargs for each in actions if type(each).__name__ == "Node"]
    (node,) = (each for each in nodes if each["package"] == "ertis_ros")
    (values,) = node["parameters"]
    assert {*values} <= {*parameters.FIXED, *parameters.LIVE}
    given = [each for each in values.values() if type(each).__name__ == "ParameterValue"]
    used = {each.args[0].args[0] for each in given} | {node["namespace"].args[0]}
    assert used <= declared
    assert declared - used <= {"rviz"}
    shown = made["__doc__"].split("ros2 launch ")[1].split("\n")[0]
    assert shown.startswith(f"ertis_ros {name}.launch.py")
    assert {*re.findall(r"(\w+):=", shown)} <= declared


@pytest.fixture
def parameters(monkeypatch):
    pytest.importorskip("rcl_interfaces.msg")
    pytest.importorskip("cyclonedds")
    monkeypatch.syspath_prepend(str(PACKAGE))
    from ertis_ros import parameters  # noqa: PLC0415  a package of its own

    return parameters


def test_defaults_are_those_of_the_command(parameters):
    fixed = {name: each.default for name, each in parameters.FIXED.items()}
    words = ["tcp://127.0.0.1:5602", "--topic", "points", "--topic", "scan", "--interface", "lo"]
    assert parameters.options_of(fixed, "") == [*words, "--reliability", "reliable", "--device", "auto"]
    live = {name: each.default for name, each in parameters.LIVE.items()}
    assert parameters.settings_of(live) == type(parameters.settings_of(live))()


def test_values_become_options_and_settings(parameters):
    given = {"source": "/dev/a '/dev/b c'", "sensors": ["front", "left"], "publish_clock": True, "trigger_rate": 5.0}
    wanted = ["/dev/a", "/dev/b c", "--sensor", "front", "--sensor", "left", "--use-sim-time", "--trigger-rate", "5.0"]
    assert parameters.options_of(given, "robot1") == [*wanted, "--namespace", "robot1"]
    live = {name: each.default for name, each in parameters.LIVE.items()}
    changes = {"first_range_m": 0.5, "max_rate_hz.image": 5.0, "paused": True, "floor_dbfs": -60.0}
    settings = parameters.settings_of(live | changes)
    assert (settings.range_m, settings.max_rate_hz, settings.paused) == ((0.5, 1000.0), {"image": 5.0}, True)
    assert settings.floor_dbfs == -60.0


def test_options_are_those_of_the_command(parameters):
    from ertis_cli.ros import ros  # noqa: PLC0415  beside the other imports of ROS

    (topics,) = (each for each in ros.params if "--topic" in each.opts)
    assert tuple(topics.type.choices) == parameters.TOPICS
    options = {name for each in ros.params for name in each.opts}
    given = {
        name: [name] if isinstance(each.default, list) else each.default for name, each in parameters.FIXED.items()
    }
    filled = {name: value if isinstance(value, bool | list) else "x" for name, value in given.items()}
    filled |= {name: True for name, value in given.items() if isinstance(value, bool)}
    words = parameters.options_of(filled, "robot1")
    assert {word for word in words if word.startswith("--")} <= options


def test_numbers_have_ranges(parameters):
    for name, each in (parameters.FIXED | parameters.LIVE).items():
        descriptor = each.descriptor(read_only=False)
        assert bool(descriptor.floating_point_range) == isinstance(each.default, float), name
        assert descriptor.description.endswith(".")


@contextmanager
def node(*arguments):
    """Run the node, and yield its process."""
    environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(OTHER_DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
    environment["PYTHONPATH"] = os.pathsep.join((environment["PYTHONPATH"], str(PACKAGE)))
    command = [sys.executable, "-m", "ertis_ros.sonar", "--ros-args", *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=WAIT_S)


CLIENT = """
import sys, time
import rclpy
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter

rclpy.init()
node = rclpy.create_node("client")
def ask(kind, name, request):
    client = node.create_client(kind, f"/robot1/sonar/{name}")
    assert client.wait_for_service(60.0)
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=60.0)
    return future.result()
(about,) = ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=["speed"])).descriptors
print(about.floating_point_range[0].from_value, about.floating_point_range[0].to_value)
for name, value in (
    ("speed", 2.0), ("speed", 200.0), ("topics", ["image"]), ("last_range_m", 2.0), ("first_range_m", 3.0)
):
    wanted = Parameter(name, value=value).to_parameter_msg()
    (result,) = ask(SetParameters, "set_parameters", SetParameters.Request(parameters=[wanted])).results
    print(name, result.successful)
print(result.reason)
"""


def test_node_publishes_and_accepts_parameters(parameters):  # noqa: ARG001  skips without ROS
    pytest.importorskip("rclpy.serialization")
    recording = ROOT / "data" / "synthetic" / "reflectors.h5"
    given = ["-p", f"source:={recording}", "-p", "loop:=true", "-r", "__ns:=/robot1"]
    with node(*given) as process:
        lines = [process.stderr.readline() for _ in range(4)]
        assert any("/robot1/sensor/points" in line for line in lines)
        environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(OTHER_DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
        client = [sys.executable, "-c", CLIENT]
        done = subprocess.run(client, capture_output=True, text=True, env=environment, timeout=120, check=True)
        limits, *results, reason, _ = done.stdout.split("\n")
        assert limits == "0.01 100.0"
        assert results == ["speed True", "speed False", "topics False", "last_range_m True", "first_range_m False"]
        assert "use the smaller number first" in reason
        end_s = time.monotonic() + WAIT_S
        while "new settings are in use" not in (line := process.stderr.readline()):
            assert line
            assert time.monotonic() < end_s


def test_node_refuses_values_out_of_range(parameters):  # noqa: ARG001  skips without ROS
    pytest.importorskip("rclpy.serialization")
    with node("-p", "min_level_db:=30.0") as process:
        error = process.stderr.read()
    assert "Parameter min_level_db out of range" in error
    assert "Traceback" not in error
