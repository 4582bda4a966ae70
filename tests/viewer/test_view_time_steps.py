"""Display times of measurements in a file: clocks set late or never, and long pauses."""

import pytest

from ertis_numba.frames import Stamp
from ertis_numba.storage import write_energyscapes
from ertis_numba.viewer import Playback
from ertis_numba.viewer._time_steps import time_steps_of
from tests.views import spot

BOOT_NS, NOW_NS, YEAR_S = 5 * 10**9, 1_763_817_458 * 10**9, 31_557_600


def time_steps(**times_ns):
    stamps = {name: [Stamp(sensor=name, timestamp_ns=at_ns) for at_ns in each] for name, each in times_ns.items()}
    return time_steps_of(stamps)


def steps(begin_ns, count, step_s=0.1):
    return [begin_ns + round(number * step_s * 1e9) for number in range(count)]


def times_s(found):
    return [moment.time_s for moment in found]


@pytest.mark.parametrize(
    ("at_ns", "iso", "utc"),
    [
        (0, None, None),
        (50_000_000, None, None),
        (-1, None, None),
        (946_684_799_999_999_999, None, None),
        (946_684_800_000_000_000, "2000-01-01T00:00:00.000000000Z", "2000-01-01 00:00:00.000 UTC"),
        (1_700_000_000_123_456_789, "2023-11-14T22:13:20.123456789Z", "2023-11-14 22:13:20.123 UTC"),
        (2**63 - 1, "2262-04-11T23:47:16.854775807Z", "2262-04-11 23:47:16.854 UTC"),
    ],
)
def test_time_is_shown_if_the_clock_was_set(at_ns, iso, utc):
    stamp = Stamp(timestamp_ns=at_ns)
    assert (stamp.is_timed, stamp.iso, stamp.utc) == (iso is not None, iso, utc)


def test_clock_set_halfway_keeps_the_order():
    found, notes = time_steps(a=steps(BOOT_NS, 3) + steps(NOW_NS, 5))
    assert times_s(found) == pytest.approx([number / 10 for number in range(8)])
    assert [dict(moment.measurements)["a"] for moment in found] == list(range(8))
    (note,) = notes
    assert note == (
        "sensor 'a': 3 of 8 measurements have no timestamp, because the clock was not set; they are shown at the "
        "typical interval"
    )


def test_clock_lost_halfway_keeps_the_order():
    found, _ = time_steps(a=steps(NOW_NS, 3) + steps(BOOT_NS, 2) + steps(NOW_NS + 10**9, 2))
    assert times_s(found) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 1.0, 1.1])


@pytest.mark.parametrize("unset_ns", [[0] * 5, steps(BOOT_NS, 5)])
def test_sensor_without_timestamps_starts_with_the_others(unset_ns):
    found, notes = time_steps(timed=steps(NOW_NS, 5), untimed=unset_ns)
    assert times_s(found) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert found[3].measurements == (("timed", 3), ("untimed", 3))
    assert [note[:34] for note in notes] == ["sensor 'untimed': 5 of 5 measureme"]


def test_simulated_and_missing_timestamps_are_kept():
    assert time_steps(a=steps(0, 3, 0.25), b=steps(0, 3, 0.25))[1] == []
    assert times_s(time_steps(a=steps(0, 3, 0.25))[0]) == [0.0, 0.25, 0.5]
    found, notes = time_steps(a=[0, 0, 0], b=[0, 0])
    assert (times_s(found), notes) == (pytest.approx([0.0, 0.1, 0.2]), [])
    assert found[1].measurements == (("a", 1), ("b", 1))
    assert time_steps(a=[0])[0][0].measurements == (("a", 0),)
    assert time_steps() == ((), [])


@pytest.mark.parametrize(
    ("times_ns", "wanted_s", "reported"),
    [
        (
            [*steps(NOW_NS, 3), NOW_NS + 3600 * 10**9],
            [0, 0.1, 0.2, 10.2],
            "a pause of more than 10 s (up to 3600 s) is",
        ),
        (steps(NOW_NS, 4, 60.0), [0, 60, 120, 180], None),  # that is how it measures
        (
            steps(NOW_NS, 3, YEAR_S),
            [0, 600, 1200],
            "2 pauses of more than 600 s (up to 31557600 s) are played as 600 s",
        ),
    ],
)
def test_long_pauses_are_shortened(times_ns, wanted_s, reported):
    found, notes = time_steps(a=times_ns)
    assert times_s(found) == pytest.approx(wanted_s)
    assert len(notes) == (reported is not None)
    assert not notes or notes[0].startswith(reported)


def test_playback_reports_replaced_timestamps(tmp_path):
    images = [spot(0, 1.0, sequence=number, timestamp_ns=at_ns) for number, at_ns in enumerate((BOOT_NS, NOW_NS))]
    with Playback(write_energyscapes(tmp_path / "img.h5", images)) as playback:
        assert times_s(playback.time_steps) == pytest.approx([0, 0.1])
        (note,) = playback.notes()
        assert note.startswith("sensor 'front': 1 of 2 measurements have no timestamp")
        assert playback.notes() == []
