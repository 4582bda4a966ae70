"""Commands and code of docs/how-to/applications.md, with an emulated sensor that replays two measurements."""

import re
import subprocess
import sys

from tests.cli import test_network_page as network
from tests.pages import environment, page, python_in, run_code_here
from tests.publishing import PATIENCE_S, Publisher, cloud

PAGE = page("applications")
place, platform, ports, words = network.place, network.platform, network.ports, network.words


def test_application_loop_of_the_page_runs(tmp_path):
    (code,) = python_in(PAGE)
    clouds = [cloud(number, position_m=[[0.3, 0.4, 0], [3, 0, 0]]) for number in range(6)]
    with Publisher() as publisher, publisher.playing(clouds):
        code = code.replace("tcp://127.0.0.1:5602", publisher.address)
        reported = run_code_here(tmp_path, code).splitlines()
    numbers = [int(re.fullmatch(r"#(\d): nearest at 0\.50 m, 2 points", line)[1]) for line in reported]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] >= 3
    assert max(numbers[:-1], default=0) < 3


def test_application_commands_of_the_page_run(place, ports, platform):
    """Nothing is near, so the vehicle may go. On a busy machine images are late, so the example waits longer."""
    lines = re.findall(r"^\$ (.*)$", PAGE, re.MULTILINE)
    assert [line.split()[1] for line in lines] == ["example", "sensors", "serve", "capture", "2_safety_stop.py"]
    *commands, example = lines
    with network.Shell(place, ports, platform) as shell:
        for command in commands:
            shell.run(command.removeprefix("ertis "))
        script = place / example.split()[1]
        code = script.read_text("utf-8")
        assert code.count("SILENCE_S = 0.5\n") == 1
        script.write_text(code.replace("SILENCE_S = 0.5\n", f"SILENCE_S = {PATIENCE_S}\n"), "utf-8")
        words = [sys.executable, "-u", *example.replace("5602", ports["5602"]).split()[1:]]
        with subprocess.Popen(words, cwd=place, env=environment(place), stdout=subprocess.PIPE, text=True) as process:
            spoken = iter(process.stdout.readline, "")
            assert next(spoken) == "stop\n"  # until there is an image
            assert "go\n" in spoken  # reads lines until it appears
            process.terminate()
