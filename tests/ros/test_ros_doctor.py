"""``ertis doctor --ros`` finds programs, and the reasons why they may receive nothing."""

import json

import pytest
from click.testing import CliRunner
from ertis_cli import _ros_diagnosis
from ertis_cli.main import cli

from ertis_numba.interop.ros_messages import MESSAGES
from tests.ros_topics import DOMAIN, subscribed

pytest.importorskip("cyclonedds")


@pytest.fixture
def doctor(monkeypatch):
    """Run the command and return its exit code and findings by name."""
    for name in ("RMW_IMPLEMENTATION", "ROS_DISCOVERY_SERVER", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.delenv(name, raising=False)

    def run(*options):
        done = CliRunner().invoke(cli, ["doctor", "--ros", "--json", *map(str, options)])
        found = {}
        for each in json.loads(done.stdout)["findings"]:
            found.setdefault(each["check"], []).append((each["state"], each["text"], each["remedy"]))
        return done.exit_code, found

    return run


def test_doctor_finds_programs_and_subscribers(doctor):
    pytest.importorskip("rclpy.serialization")
    with subscribed({"/front/points": MESSAGES["points"]}):
        code, found = doctor("--domain", DOMAIN)
    assert code == 0
    ((state, text, _),) = found["ROS programs"]
    assert state == "good"
    assert text == f"1 other participant in domain {DOMAIN} on lo"
    (points,) = [text for _, text, _ in found["ROS subscriber"] if text.startswith("/front/points ")]
    assert points.startswith("/front/points  sensor_msgs/msg/PointCloud2, reliable")


def test_doctor_explains_an_empty_domain(doctor, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "231")
    code, found = doctor()
    assert code == 0
    ((state, text, remedy),) = found["ROS programs"]
    assert (state, text) == ("note", "0 other participants in domain 231 on lo")
    assert "UDP ports 65150 to 65399 and multicast" in remedy
    assert found["ROS domain"] == [("good", "231 (ROS_DOMAIN_ID) on lo; others must use the same", "")]


@pytest.mark.parametrize(
    ("name", "value", "check"),
    [
        ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp", "ROS middleware"),
        ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811", "ROS discovery"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "off", "ROS discovery"),
    ],
)
def test_doctor_reports_variables_that_prevent_exchange(doctor, monkeypatch, name, value, check):
    monkeypatch.setenv(name, value)
    code, found = doctor("--domain", DOMAIN)
    ((state, text, remedy),) = found[check]
    assert (code, state) == (1, "bad")
    assert name in text
    assert remedy


@pytest.mark.parametrize(
    ("options", "message"),
    [(("--domain", 233), "domain is 233"), (("--interface", "nothing0"), "interface 'nothing0' is unknown")],
)
def test_doctor_reports_a_domain_that_cannot_be_joined(doctor, options, message):
    code, found = doctor(*options)
    ((state, text, remedy),) = found["ROS domain"]
    assert (code, state) == (1, "bad")
    assert text.startswith(message)
    assert remedy


@pytest.mark.parametrize(("flags", "text"), [("0x1002", "down"), ("0x3", "no multicast")])
def test_doctor_reports_interfaces_that_cannot_be_used(tmp_path, monkeypatch, flags, text):
    (tmp_path / "eth7").mkdir()
    (tmp_path / "eth7" / "flags").write_text(f"{flags}\n")
    monkeypatch.setattr(_ros_diagnosis, "_CLASSES", tmp_path)
    monkeypatch.setattr(_ros_diagnosis, "_CONTAINER", tmp_path)
    container, finding = _ros_diagnosis._interface("eth7")  # noqa: SLF001  no machine has such interfaces
    assert container.remedy == "use the network of the host (docker run --network host)"
    assert finding.state == "bad"
    assert text in finding.text


def test_options_of_ros_need_the_flag():
    done = CliRunner().invoke(cli, ["doctor", "--domain", "3"])
    assert done.exit_code == 2
    assert "--domain and --interface require --ros; add --ros" in done.stderr
