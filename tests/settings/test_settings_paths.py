"""Changes of nested settings by dotted path, such as ``processing.range_m``."""

import re

import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Accuracy, Processing, Settings
from ertis_numba.simulation import Scene


def test_path_changes_one_nested_value():
    changed = Settings().replace("processing.range_m", (0.5, 3))
    assert changed == Settings(processing=Processing(range_m=(0.5, 3.0)))
    assert Settings().replace("accuracy", Accuracy(max_error_db=-50)) == Settings(accuracy=Accuracy(max_error_db=-50))
    assert Processing().replace("dmas_order", 3) == Processing().replace(dmas_order=3)


def test_several_paths_are_changed_and_checked_together():
    changes = {"processing.decimation": 15, "processing.range_decimation": 150, "accuracy.max_error_db": -50}
    assert Settings().replace(**changes) == Settings(
        processing=Processing(decimation=15, range_decimation=150), accuracy=Accuracy(max_error_db=-50)
    )
    with pytest.raises(ArgumentError, match=r"processing.decimation is 15; use a divisor"):
        Settings().replace("processing.decimation", 15)


def test_paths_apply_to_tables_of_the_same_call():
    changed = Settings().replace("processing.dmas_order", 4, processing=Processing(directions="2d:9"))
    assert changed.processing == Processing(directions="2d:9", dmas_order=4)
    assert Settings().replace(processing=Processing(dmas_order=4)).processing.dmas_order == 4
    assert Settings().replace() == Settings()


def test_path_value_may_be_none():
    fixed = Settings().replace("accuracy.delay_taps", 2)
    assert fixed.replace("accuracy.delay_taps", None) == Settings()


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("processing.rangem", "settings key 'processing.rangem' is unknown (did you mean 'processing.range_m'"),
        ("range_m", "settings key 'range_m' is unknown (did you mean 'processing.range_m'?); known are array, call"),
        ("sample_rate_hz", "did you mean 'call.sample_rate_hz' or 'recording.sample_rate_hz'?"),
        ("max_error", "did you mean 'accuracy.max_error_db'"),
        ("procesing.range_m", "did you mean 'processing.range_m'?"),
        ("accuracy.zzz", "settings key 'accuracy.zzz' is unknown; known in 'accuracy' are max_error_db, precision"),
        ("zzz", "settings key 'zzz' is unknown; known are array, call, recording, air, processing, accuracy"),
        (
            "processing.range_m.first",
            "processing key 'range_m.first' is unknown: range_m is not a table; use",
        ),
    ],
)
def test_unknown_path_is_refused_with_similar_paths(path, message):
    with pytest.raises(ArgumentError, match=re.escape(message)) as caught:
        Settings().replace(path, 1)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_values_of_paths_are_checked():
    with pytest.raises(ArgumentError, match=r"accuracy.max_error_db is 3; use a number from -200 to 0"):
        Settings().replace("accuracy.max_error_db", 3)
    with pytest.raises(ArgumentError, match=r"processing.range_m is 3"):
        Settings().replace("processing.range_m", 3)


def test_scene_replace_accepts_paths():
    changed = Scene().replace("seed", 3)
    assert changed == Scene(seed=3)
