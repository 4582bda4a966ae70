"""Settings of ``ertis ros`` that change while it runs."""

import json
import subprocess
import time

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.interop.ros_messages import MESSAGES, points_message
from ertis_numba.interop.scans import scan_message
from ertis_numba.ros import Participant, PublishingSettings, RosPublisher, WatchedSettings
from ertis_numba.storage import write_energyscapes
from tests.files import with_echoes
from tests.journals import ENVIRONMENT
from tests.network.test_capture_to import ERTIS
from tests.pages import page
from tests.ros.test_ros import equal, stamped
from tests.ros_topics import DOMAIN, await_subscribers, subscribed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("min_level_db = 3", "min_level_db is 3"),
        ("floor_dbfs = -2000", "floor_dbfs is -2000"),
        ("range_m = [3, 1]", "use the smaller number first"),
        ("speed = 0", "speed is 0"),
        ("[max_rate_hz]\ncloud = 1", "topic 'cloud' is unknown"),
        ("[max_rate_hz]\npoints = 0", "max_rate_hz is 0"),
        ("pause = true", "unknown"),
        ("paused = 1", "paused: Expected `bool`"),
    ],
)
def test_settings_refuse_bad_values(text, message):
    with pytest.raises(SettingsError, match=message):
        PublishingSettings.from_toml(text)
    with pytest.raises(ArgumentError):
        PublishingSettings(min_level_db=1.0)


def test_settings_of_the_page_are_valid():
    (text,) = (block.split("```")[0] for block in page("ros").split("```toml\n")[1:])
    assert PublishingSettings.from_toml(text) == PublishingSettings(
        min_level_db=-15.0, floor_dbfs=-60.0, range_m=(0.5, 3.0), max_rate_hz={"image": 5.0}
    )


def test_file_is_read_again_once_it_is_complete(tmp_path):
    path = tmp_path / "control.toml"
    path.write_text("speed = 2")
    watched = WatchedSettings(path)
    assert (watched.settings.speed, watched.changed()) == (2.0, None)
    path.write_text("")  # An editor has begun to write.
    assert watched.changed() is None
    path.write_text("speed = 3.25")
    assert watched.changed() is None
    assert watched.changed().speed == 3.25
    assert watched.changed() is None
    path.write_text("speed = 'x'")
    assert watched.changed() is None
    with pytest.raises(SettingsError, match=r"control.toml, line 1, speed"):
        watched.changed()
    assert (watched.changed(), watched.settings.speed) == (None, 3.25)
    path.unlink()
    assert watched.changed() is None
    with pytest.raises(SettingsError, match="is missing; its last settings stay in use"):
        watched.changed()
    path.write_text("paused = true")
    assert watched.changed() is None
    assert watched.changed().paused


def test_ranges_and_levels_limit_points_and_echoes():
    given = with_echoes(stamped(1))
    cloud = PointFinder(min_level_db=-40.0)(given)
    middle_m = float(np.median(cloud.range_m))
    limits = PublishingSettings(range_m=(middle_m, 100.0), min_level_db=-40.0)
    kinds = {f"/front/{topic}": MESSAGES[topic] for topic in ("points", "scan")}
    with Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant)
        ros.publish(given)  # creates the topics, before there are subscribers that could receive this image
        with subscribed(kinds) as subscriber:
            await_subscribers([ros.topics[name] for name in kinds])
            ros.settings = PublishingSettings(paused=True)
            ros.publish(given)
            assert ros.left_out == 2
            ros.settings = limits
            ros.publish(given)
            taken = subscriber.take(2)
            ros.settings = PublishingSettings(range_m=(90.0, 100.0))
            ros.publish(given)
            (empty,) = subscriber.take(1)["/front/points"]  # There is no scan without ranges.
    far = np.asarray(cloud.range_m) >= middle_m
    assert 0 < far.sum() < len(cloud)
    far_cloud = cloud.replace(
        position_m=cloud.position_m[far], amplitude=cloud.amplitude[far], uncertainty_m=cloud.uncertainty_m[far]
    )
    scan = scan_message(given.select(range_m=(middle_m, 100.0)), min_level_db=-40.0)
    none = far_cloud.replace(
        position_m=far_cloud.position_m[:0],
        amplitude=far_cloud.amplitude[:0],
        uncertainty_m=np.zeros((0, 2), np.float32),
    )
    assert equal(taken["/front/points"][0], points_message(far_cloud), MESSAGES["points"])
    assert equal(taken["/front/scan"][0], scan, MESSAGES["scan"])
    assert equal(empty, points_message(none), MESSAGES["points"])


def test_command_obeys_its_control_file(tmp_path):
    path, control = tmp_path / "images.h5", tmp_path / "control.toml"
    write_energyscapes(path, [stamped(seed, sequence=20_000_000 * seed) for seed in range(5)])
    control.write_text("speed = 2.0")
    command = [*ERTIS, "ros", path, "--domain", str(DOMAIN), "--loop", "--use-sim-time", "--json", "--control", control]
    with subprocess.Popen(
        command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            events = (json.loads(line) for line in process.stdout)

            def replace(text):
                """Replace the file at once, so that the command never reads an empty one."""
                new = tmp_path / "new.toml"
                new.write_text(text)
                new.replace(control)

            def text_of_note():
                return next(event["text"] for event in events if event["event"] == "note")

            while next(events).get("topic") != "/front/points":
                pass
            replace("paused = true")
            assert text_of_note() == "new settings are in use"
            replace("speed = nothing")
            assert "control.toml" in (text := text_of_note())
            assert text.endswith("; the former settings stay in use")
            replace("speed = 4.0")
            assert text_of_note() == "new settings are in use"
        finally:
            process.terminate()
            last = json.loads(process.stdout.read().splitlines()[-1])
    assert last["event"] == "end"
    assert last["measurements"] > 0


def test_file_waits_while_it_is_paused(tmp_path):
    path, control = tmp_path / "images.h5", tmp_path / "control.toml"
    write_energyscapes(path, [stamped(seed, sequence=20_000_000 * seed) for seed in range(5)])
    control.write_text("paused = true")
    begun_s = time.monotonic()
    arguments = ["ros", str(path), "--domain", str(DOMAIN), "--duration", "1", "--json", "--control", str(control)]
    done = CliRunner().invoke(cli, arguments)
    assert (done.exit_code, time.monotonic() - begun_s >= 1) == (0, True)
    assert json.loads(done.stdout.splitlines()[-1])["measurements"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--min-level", "-3"], "--min-level and --control cannot be combined; set the value in the file"),
        (["--rate", "2"], "--rate and --control cannot be combined"),
        (["--max-rate", "points=2"], "--max-rate and --control cannot be combined"),
    ],
)
def test_options_and_control_file_exclude_each_other(tmp_path, options, message):
    control, path = tmp_path / "control.toml", tmp_path / "images.h5"
    control.write_text("")
    write_energyscapes(path, [stamped(1)])
    done = CliRunner().invoke(cli, ["ros", str(path), "--control", str(control), *options])
    assert done.exit_code == 2
    assert message in done.stderr


def test_missing_control_file_is_reported(tmp_path):
    path = tmp_path / "images.h5"
    write_energyscapes(path, [stamped(1)])
    done = CliRunner().invoke(cli, ["ros", str(path), "--control", str(tmp_path / "none.toml")])
    assert done.exit_code == 1
    assert "none.toml" in done.stderr
