"""Cache of the simulation: counted memory, discarded results, and results of unknown size."""

import gc
import tracemalloc

import numpy as np
import pytest

from ertis_numba.settings import Processing
from ertis_numba.simulation import Point, Scene, Sensor, Wall, effect_plan
from ertis_numba.simulation.cache import Cache
from ertis_numba.simulation.effect_plan import make_plan

_BEAMS_BYTES = 1000 * 32 * 16  # of the phases for 1000 directions and 32 microphones
_WALL = Wall(position_m=(0.0, 1.5, 0.0), facing_deg=(-90.0, 0.0))


def test_cache_counts_the_memory_of_all_kept_results(monkeypatch):
    """The first plan fills all caches that outlast a scene, so that the second one allocates only its own results."""
    processing = Processing(directions="3d:1000")
    sensors = tuple(
        Sensor(name=name, position_m=(0.0, y_m, 0.0), processing=processing) for name, y_m in (("a", 0.0), ("b", 0.3))
    )
    moving = Point(waypoints=((0.0, 1.0, 0.3, 0.0), (0.3, 1.1, 0.3, 0.0)))
    scene = Scene(sensors=sensors, points=(moving, Point(range_m=2.0)), walls=(_WALL,), count=3)
    caches = []
    monkeypatch.setattr(effect_plan, "Cache", lambda: caches.append(Cache()) or caches[-1])
    monkeypatch.setattr(effect_plan, "_ab_render_of", lambda _: lambda *_: 0.0)
    make_plan(scene)
    caches.clear()
    gc.collect()
    tracemalloc.start()
    try:
        make_plan(scene)
        gc.collect()
        kept_bytes = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    (cache,) = caches
    assert _BEAMS_BYTES < kept_bytes < cache.n_bytes
    assert cache.n_bytes < 2 * kept_bytes + 2**20
    # Sensors with equal settings share the beams of all measurements.
    assert kept_bytes < 8 * _BEAMS_BYTES


def test_cache_discards_the_least_recently_used_result():
    cache = Cache(max_bytes=250_000)
    made = []

    def get(key):
        cache.once(key, lambda: made.append(key) or np.zeros(10_000))

    for key in ("a", "b", "a", "c", "d", "a", "b"):
        get(key)
        assert cache.n_bytes <= 250_000
    assert made == ["a", "b", "c", "d", "b"]


def test_cache_keeps_a_result_larger_than_its_limit_alone():
    cache = Cache(max_bytes=10_000)
    cache.once("small", lambda: 1.0)
    large = cache.once("large", lambda: np.zeros(10_000))
    assert cache.once("large", lambda: None) is large
    assert cache.once("small", lambda: 2.0) == 2.0


def test_cache_refuses_results_of_unknown_size():
    with pytest.raises(TypeError, match="size of set is unknown; add a property nbytes"):
        Cache().once("key", lambda: {1, 2})
