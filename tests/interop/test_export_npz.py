"""NPZ files preserve energyscapes bit by bit, without pickle."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Stamp
from ertis_numba.interop import FORMATS, export
from ertis_numba.settings import Air, Settings
from tests.files import SMALL, image


def images(count=3):
    return [
        image(seed=seed).replace(
            stamp=Stamp(
                sensor="eRTIS-7",
                sequence=2**40 + seed,
                session_id=2**62 + seed,
                sync_count=5 + seed,
                timestamp_ns=-seed,
                timestamp_uncertainty_ns=400 + seed,
            )
        )
        for seed in range(count)
    ]


@pytest.mark.parametrize("given", [tuple(images()), iter(images())], ids=["of known length", "as they come"])
def test_npz_preserves_energyscapes_bit_by_bit(tmp_path, given):
    wanted = images()
    (path,) = export(tmp_path / "a.npz", given)
    with np.load(path, allow_pickle=False) as data:
        assert tuple(data) == FORMATS["npz"].fields
        assert data["amplitude"].dtype == np.float32
        assert np.array_equal(data["amplitude"], [each.amplitude for each in wanted])
        for name in ("azimuth_rad", "elevation_rad", "range_m"):
            assert np.array_equal(data[name], getattr(wanted[0], name))
            assert data[name].dtype == np.float64
        names = ("session_id", "sequence", "sync_count", "timestamp_ns", "timestamp_uncertainty_ns")
        columns = zip(*(data[name].tolist() for name in names), strict=True)
        back = [Stamp(sensor=str(data["sensor"]), **dict(zip(names, row, strict=True))) for row in columns]
        assert back == [each.stamp for each in wanted]
        settings = Settings.from_toml(str(data["settings"]))
        assert settings.replace(array=SMALL.array) == SMALL
        assert len(settings.array.positions_m) == 32  # no other file is needed


def test_equal_images_give_equal_npz_files(tmp_path):
    first, second = (export(tmp_path / f"{name}.npz", images())[0].read_bytes() for name in "ab")
    assert first == second


def test_images_with_different_axes_are_refused(tmp_path):
    first, second = images(2)
    cold = second.replace(settings=SMALL.replace(air=Air(temperature_c=0.0)))
    for other, message in (
        (second.replace(stamp=Stamp(sensor="other")), "sensors eRTIS-7 and other cannot share the axes"),
        (second.replace(range_m=second.range_m + 0.1), "another range_m than the first, for example"),
        (second.replace(azimuth_rad=second.azimuth_rad / 2), "another azimuth_rad than the first"),
        (cold, "has other settings than the first; export it to its own npz"),
    ):
        with pytest.raises(ArgumentError, match=message):
            export(tmp_path / "a.npz", [first, other])
    with pytest.raises(ArgumentError, match="no energyscape is passed; pass at least one"):
        export(tmp_path / "a.npz", [])
    assert list(tmp_path.iterdir()) == []
