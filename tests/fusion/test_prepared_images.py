"""Images whose echoes threads find before, while and after their pulse is fused."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ertis_numba.analysis.points import EchoPointExtractor
from ertis_numba.fusion import Fuser
from tests.publishing import image

AHEAD, BEHIND = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
MOUNTINGS = {
    "front": ((0.2, 0.05, 0.0), AHEAD),
    "beside": ((0.2, -0.05, 0.0), AHEAD),
    "back": ((-0.2, 0.0, 0.0), BEHIND),
}
PATIENCE_S = 60.0


def pulse(number):
    """Images of three sensors, each with two reflectors, one of which moves."""
    return [
        image(number, sensor=sensor, reflectors=[(20.0, range_m + 0.05 * number, 0.1), (-30.0, 1.7, 0.05)])
        for sensor, range_m in zip(MOUNTINGS, (1.3, 1.32, 1.0), strict=True)
    ]


def values(fused):
    points = fused.points
    return fused.image.amplitude, points.position_m, points.amplitude, points.uncertainty_m, points.confirmed


def in_use():
    """A fuser with tables for the images."""
    fuser = Fuser(MOUNTINGS)
    assert fuser(pulse(0)).image.amplitude.any()
    return fuser


@pytest.fixture
def held(monkeypatch):
    """Hold the threads that find echoes until an event; return it, the threads that came, and their semaphore."""
    extract, free, came, begun = EchoPointExtractor.__call__, threading.Event(), [], threading.Semaphore(0)

    def hold(extractor, found):
        came.append((threading.current_thread().name.split("_")[0], found.stamp.sensor))
        begun.release()
        if came[-1][0] == "held":
            assert free.wait(PATIENCE_S)
        return extract(extractor, found)

    monkeypatch.setattr(EchoPointExtractor, "__call__", hold)
    yield free, came, begun
    free.set()


@pytest.mark.parametrize("n_threads", [1, 2, 4])
def test_fused_pulses_do_not_depend_on_the_threads_that_find_their_echoes(n_threads):
    alone, helped = in_use(), in_use()
    with ThreadPoolExecutor(n_threads) as pool:
        for number in range(1, 6):
            images = pulse(number)
            for each in images:
                pool.submit(helped.prepare, each)
            for one, other in zip(values(helped(images)), values(alone(images)), strict=True):
                np.testing.assert_array_equal(one, other)


def test_fusion_takes_the_echoes_that_threads_find_and_finds_only_the_others(held):
    free, came, begun = held
    fuser, images = in_use(), pulse(1)
    came.clear()
    with ThreadPoolExecutor(1, thread_name_prefix="held") as pool:
        while begun.acquire(blocking=False):
            pass
        pool.submit(fuser.prepare, images[0])
        assert begun.acquire(timeout=PATIENCE_S)
        waiting = threading.Thread(target=lambda: fuser(images).image, name="fusing")
        waiting.start()
        for _ in images[1:]:
            assert begun.acquire(timeout=PATIENCE_S)
        free.set()
        waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
    assert came == [("held", "front"), ("fusing", "beside"), ("fusing", "back")]


def test_interrupted_search_is_made_again(monkeypatch):
    fuser, images = in_use(), pulse(1)
    extract, interrupts = EchoPointExtractor.__call__, [KeyboardInterrupt]

    def interrupted(extractor, found):
        if interrupts:
            raise interrupts.pop()
        return extract(extractor, found)

    monkeypatch.setattr(EchoPointExtractor, "__call__", interrupted)
    fused = fuser(images)
    with pytest.raises(KeyboardInterrupt):
        fused.points  # noqa: B018
    np.testing.assert_array_equal(fused.points.position_m, in_use()(images).points.position_m)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no forks")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_fork_does_not_wait_for_echoes_that_a_thread_of_its_parent_finds(held):
    free, _, begun = held
    fuser, images = in_use(), pulse(1)
    fused = fuser(images)
    with ThreadPoolExecutor(1, thread_name_prefix="held") as pool:
        while begun.acquire(blocking=False):
            pass
        pool.submit(fuser.prepare, images[0])
        assert begun.acquire(timeout=PATIENCE_S)
        process_id = os.fork()
        if not process_id:
            signal.alarm(round(PATIENCE_S))
            try:
                os._exit(0 if len(fused.points) else 1)
            finally:
                os._exit(2)
        free.set()
    assert os.waitpid(process_id, 0)[1] == 0
