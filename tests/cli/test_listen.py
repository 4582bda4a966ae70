"""Output, saved files and exit of ``ertis listen`` with a publisher."""

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli._product_printer import ProductTable
from ertis_cli.main import cli

from ertis_numba.network.keys import KeyPair
from ertis_numba.network.products import Arrival
from ertis_numba.storage import open_energyscapes, open_recording, sensor_names
from tests.central import running
from tests.pages import environment
from tests.publishing import (
    PATIENT_APPLICATIONS,
    Publisher,
    cloud,
    end_when,
    events_of,
    group,
    image,
    measurement,
    patient_applications,
    results_of,
    status,
)

__all__ = ["patient_applications"]  # A fixture, imported for use here.

pytestmark = PATIENT_APPLICATIONS


def listen(*arguments):
    return CliRunner().invoke(cli, ["listen", *map(str, arguments)])


def heard(items, *arguments):
    """Run ``ertis listen`` on published items until it ends by itself, and return its result."""
    with Publisher() as publisher, publisher.playing(items):
        return listen(publisher.address, *arguments)


def events(done):
    assert done.exit_code == 0, (done.stderr, done.exception)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_listen_prints_a_line_per_image():
    done = heard([image(7, reflectors=[(-30, 2.0, 0.9), (24, 1.2, 0.5)]), image(8)], "-n", 2)
    assert done.exit_code == 0, done.stderr
    head, first, second = done.stdout.splitlines()
    assert head.split() == ["sensor", "sequence", "age", "made", "in", "dropped", "what"]
    assert first.split()[:2] == ["front", "7"]
    assert first.endswith("1.200 m at +24.0°, +0.0°")
    assert "12.0 ms" in first
    assert second.endswith("no reflector")
    assert done.stderr.splitlines() == ["2 received, 0 dropped"]


def test_listen_prints_events_of_every_product():
    items = [
        image(1, reflectors=[(0, 1.5, 1)]),
        cloud(2, position_m=[[3, 0, 0], [0, 0, 2]]),
        measurement(3),
        group(4, "front", missing=("left",)),
        status(),
    ]
    products = [word for name in ("energyscape", "points", "raw", "group", "status") for word in ("--product", name)]
    first, *came, last = events(heard(items, *products, "-n", 5, "--json", "-q"))
    assert first["event"] == "subscribed"
    assert [each["event"] for each in came] == ["energyscape", "points", "raw", "group", "status"]
    assert [each["number"] for each in came] == [0, 1, 2, 3, 4]
    nearest = {"azimuth_deg": pytest.approx(0.0, abs=0.05), "elevation_deg": 0.0}
    assert came[0]["nearest"] == nearest | {"range_m": pytest.approx(1.5, abs=1e-3)}
    assert (came[0]["sensor"], came[0]["session_id"], came[0]["sequence"], came[0]["made_in_ms"]) == (
        "front",
        7,
        1,
        12.0,
    )
    stamp = ("sync_count", "timestamp_ns", "uncertainty_ns", "monotonic_ns")
    assert all(isinstance(each[name], int) for each in came[:3] for name in stamp)
    assert came[1]["nearest"] == {"azimuth_deg": 0.0, "elevation_deg": 90.0, "range_m": 2.0}
    assert came[1]["n_points"] == 2
    assert came[2]["age_ms"] > 0
    assert came[3]["missing"] == ["left"]
    assert came[4]["state"] == "processing"
    assert (last["event"], last["received"], last["dropped"], last["reconnects"]) == ("listened", 5, 0, 0)


def test_listen_saves_energyscapes_of_several_sensors(tmp_path):
    path = tmp_path / "image.h5"
    sent = [image(1), image(5, sensor="left"), image(2)]
    done = heard(sent, "-n", 3, "--save", path)
    assert done.exit_code == 0, done.stderr
    assert sensor_names(path) == ("front", "left")
    with open_energyscapes(path, sensor="front") as images:
        assert [each.stamp for each in images] == [sent[0].stamp, sent[2].stamp]
        np.testing.assert_array_equal(images[1].amplitude, sent[2].amplitude)
        np.testing.assert_array_equal(images.translation_m, Publisher.translation_m)


def test_listen_saves_measurements_with_their_mounting(tmp_path):
    path = tmp_path / "raw.h5"
    sent = [measurement(1), measurement(3, temperature_c=25.0)]
    done = heard(sent, "--product", "raw", "-n", 2, "--save", path, "-q")
    assert done.exit_code == 0, done.stderr
    with open_recording(path) as recording:
        assert [each.stamp for each in recording] == [each.stamp for each in sent]
        assert [(gap.first, gap.last) for gap in recording.gaps] == [(2, 2)]
        np.testing.assert_array_equal(recording[1].data, sent[1].data)
        assert recording[1].settings.air.temperature_c == 25.0
        np.testing.assert_array_equal(recording.translation_m, Publisher.translation_m)
    assert [each.name for each in tmp_path.iterdir()] == ["raw.h5"]


@pytest.mark.parametrize(("options", "code"), [((), 0), (("-n", "9"), 130)])
def test_ctrl_c_ends_listen_and_keeps_received_images(tmp_path, options, code):
    path = tmp_path / "image.h5"
    with Publisher() as publisher, publisher.playing([image(1)]):
        command = [sys.executable, "-m", "ertis_cli.main", "listen", publisher.address, "--json", "--save", str(path)]
        with subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(tmp_path)
        ) as process:
            came = events_of(process.stdout)
            reported = [next(came)["event"] for _ in range(2)]
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate()
    assert reported == ["subscribed", "energyscape"]
    assert json.loads(rest)["event"] == "listened"
    assert process.returncode == code, errors
    with open_energyscapes(path) as images:
        assert len(images) == 1


def test_unstorable_image_ends_listen_and_keeps_earlier_ones(tmp_path):
    path = tmp_path / "image.h5"
    shorter = image(2).replace(amplitude=image(2).amplitude[:, :50].copy(), range_m=image(2).range_m[:50])
    with Publisher(describes_each=True) as publisher, publisher.playing([image(1), shorter, image(3)]):
        done = listen(publisher.address, "-n", 3, "--save", path)
    assert done.exit_code == 1
    assert "range_m of an energyscape differs from that of the first; write it to another file" in str(
        done.stderr
    ) + str(done.exception)
    with open_energyscapes(path) as images:
        assert [each.stamp.sequence for each in images] == [1]


@pytest.mark.parametrize("product", ["energyscape", "raw"])
def test_listen_without_images_writes_no_file(tmp_path, monkeypatch, product):
    connected = results_of(monkeypatch, ProductTable, "subscribed")
    end_when(monkeypatch, "ertis_cli.listen", lambda: connected)
    with Publisher() as publisher, publisher.playing([]):
        done = listen(
            publisher.address, "--product", product, "--save", tmp_path / "none.h5", "--duration", 0.2, "--json"
        )
    assert done.exit_code == 1
    received = {"raw": "measurement", "energyscape": "image"}[product]
    reason = f"none.h5 is not written, because no {received} was received; check 'ertis sensors status', or run "
    reason += "the command longer"
    assert reason in done.stderr or reason in str(done.exception)
    last = json.loads(done.stdout.splitlines()[-1])
    assert (last["event"], last["received"], last["output"]) == ("listened", 0, None)
    assert not list(tmp_path.iterdir())


def test_listen_reports_too_few_images_within_its_duration(monkeypatch):
    printed = results_of(monkeypatch, ProductTable, "product")
    end_when(monkeypatch, "ertis_cli.listen", lambda: printed)
    done = heard([image(1)], "-n", 2, "--duration", 0.5)
    assert done.exit_code == 1
    assert "received 1 of 2 products in 0.5 s; use a longer --duration" in done.stderr


def test_unanswered_address_is_reported_once(monkeypatch):
    monkeypatch.setattr("ertis_cli._product_printer._SOON_S", 0.1)
    reported = results_of(monkeypatch, ProductTable, "unanswered")
    clock = SimpleNamespace(monotonic=lambda: 0.2 * len(reported))
    monkeypatch.setattr("ertis_cli.listen.time", clock)
    text = "waiting for tcp://127.0.0.1:1: no answer; is 'ertis serve' running?"
    done = listen("tcp://127.0.0.1:1", "--duration", "0.6", "--json")
    assert done.exit_code == 1
    *lines, error = done.stderr.splitlines()
    assert lines == [text, "0 received, 0 dropped"]
    assert error.startswith("ertis: error: tcp://127.0.0.1:1 has not answered in 0.6")
    waiting, _ = map(json.loads, done.stdout.splitlines())
    assert waiting == {"event": "waiting", "address": "tcp://127.0.0.1:1", "text": text}


@pytest.mark.parametrize("output", ["--fuse", "--odometry", "--bearings"])
def test_computed_output_without_an_answer_fails_as_products_do(output):
    done = listen("tcp://127.0.0.1:1", output, "--duration", "0.2")
    assert done.exit_code == 1
    assert re.search(r"ertis: error: tcp://127\.0\.0\.1:1 has not answered in \d", done.stderr.splitlines()[-1])


@pytest.mark.parametrize(
    ("product", "text"),
    [
        (
            "energyscape",
            "no energyscape received from tcp://here yet; is 'ertis capture --to' running without --passive?",
        ),
        ("raw", "no raw received from tcp://here yet; is 'ertis capture --to' running?"),
    ],
)
def test_silence_is_reported_at_the_end_without_a_delay(capsys, product, text):
    heard = ProductTable(as_json=False, quiet=False)
    heard.subscribed("tcp://here", (), (product,))
    heard.silent("tcp://here", (product,), 0)
    assert not capsys.readouterr().err
    heard.silent("tcp://here", (product,), 0, at_end=True)
    assert text in capsys.readouterr().err
    heard.require_answer("tcp://here", 1.0)


def test_points_use_the_directions_of_each_image(capsys):
    """The output keeps part of the previous image, but must not keep its directions."""
    heard, flat = ProductTable(as_json=True, quiet=True), image(1, reflectors=[(0, 1.5, 1)])
    raised = replace(flat, elevation_rad=np.full_like(flat.elevation_rad, np.radians(20.0)))
    for item in (flat, raised):
        heard.product(
            Arrival(item, SimpleNamespace(number=0, product="energyscape"), 0, 0, 0), SimpleNamespace(dropped=0)
        )
    found = [json.loads(line)["nearest"]["elevation_deg"] for line in capsys.readouterr().out.splitlines()]
    assert found == [0.0, 20.0]


def test_late_sensor_is_reported(capsys, monkeypatch):
    monkeypatch.setattr("ertis_cli._product_printer._SOON_S", 3.0)
    heard = ProductTable(as_json=False, quiet=False)
    heard.unanswered("tcp://127.0.0.1:1", 2.0)
    heard.unanswered("tcp://127.0.0.1:1", 4.0)
    heard.note("connected")
    assert [line.split()[0] for line in capsys.readouterr().err.splitlines()] == ["waiting", "connected"]


def test_prompt_sensor_is_not_reported(capsys):
    heard = ProductTable(as_json=False, quiet=False)
    heard.note("connected")
    heard.unanswered("tcp://127.0.0.1:1", 4.0)
    assert capsys.readouterr().err == ""


def test_sensor_address_is_distinguished_from_image_address(tmp_path):
    with running(tmp_path) as central:
        done = listen(central.address)
    assert done.exit_code == 1
    assert done.stderr.splitlines()[-1].endswith(
        f"{central.address}: this address is for sensor nodes; applications use the address that "
        "'ertis serve' prints as publish"
    )


@pytest.mark.parametrize("product", ["energyscape", "raw"])
@pytest.mark.parametrize("folder", ["none", "/proc"])
def test_invalid_output_file_is_refused_at_once(product, folder):
    done = listen("tcp://127.0.0.1:1", "--product", product, "--save", f"{folder}/x.h5")
    assert done.exit_code == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"ertis: error: --save {folder}/x.h5: folder {folder} cannot be written (No such file or")


def test_invalid_duration_and_key_are_refused(tmp_path):
    secret, _ = KeyPair.new("me").save(tmp_path / "keys")
    for arguments, reported, code in (
        (("--duration", "0"), "--duration is 0; use a number above 0", 2),
        (("--key", secret, "--server-key", "abc"), "--server-key: 'abc' is neither a public key nor a file with", 1),
    ):
        done = listen("tcp://127.0.0.1:1", *arguments)
        assert done.exit_code == code
        assert reported in done.stderr


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (
            ("--product", "group", "--save", "x.h5"),
            "--save writes one product; combine it only with --product energyscape",
        ),
        (("--product", "raw", "--product", "energyscape", "--save", "x.h5"), "--save writes one product"),
        (("--key", "me"), "--key is given without --server-key"),
    ],
)
def test_listen_refuses_invalid_usage(arguments, match):
    done = listen("tcp://127.0.0.1:1", *arguments)
    assert done.exit_code == 2
    assert match in done.stderr


@pytest.mark.parametrize(("n_received", "lines"), [(0, 1), (3, 0)])
def test_silence_is_reported_once(monkeypatch, capsys, n_received, lines):
    monkeypatch.setattr("ertis_cli._product_printer._SILENT_S", 0.0)
    heard = ProductTable(as_json=False, quiet=False)
    heard.silent("tcp://here", ("energyscape",), 0)  # not connected yet; another message reports this
    heard.subscribed("tcp://here", (), ("energyscape",))
    for _ in range(2):
        heard.silent("tcp://here", ("energyscape",), n_received)
    reported = capsys.readouterr().err.splitlines()
    assert len(reported) == lines
    assert all(
        "no energyscape received from tcp://here yet; is 'ertis capture --to' running without --passive?" in line
        for line in reported
    )
