"""``Pipeline.process_many`` is an iterator with bounded memory."""

import gc
import itertools
import weakref
from dataclasses import replace

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Stamp
from ertis_numba.pipeline import Pipeline, pipeline as pipelines
from ertis_numba.settings import Air
from tests.cases import SHORT, noise

pytestmark = pytest.mark.usefixtures("sound_unchecked")

MEASUREMENTS = [replace(noise(SHORT, seed), stamp=Stamp(sequence=seed)) for seed in range(5)]


@pytest.fixture(scope="module")
def pipeline():
    with Pipeline(SHORT, "cpu", predict=False) as made:
        yield made


class Source:
    """An endless source that counts the measurements it has given."""

    def __init__(self):
        self.given = 0

    def __iter__(self):
        for measurement in itertools.cycle(MEASUREMENTS):
            self.given += 1
            yield measurement


@pytest.mark.parametrize("batch_size", [None, 1, 2, 5, 9])
def test_process_many_yields_the_images_of_process_in_order(pipeline, batch_size):
    images = list(pipeline.process_many(iter(MEASUREMENTS), batch_size=batch_size))
    assert [image.stamp.sequence for image in images] == [0, 1, 2, 3, 4]
    for image, measurement in zip(images, MEASUREMENTS, strict=True):
        assert np.array_equal(image.amplitude, pipeline.process(measurement).amplitude)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_process_many_reads_no_further_ahead_than_its_batch(pipeline, batch_size):
    source = Source()
    images = pipeline.process_many(source, batch_size=batch_size)
    assert source.given == 0
    for count in range(1, 8):
        assert next(images).amplitude.any()
        assert source.given == -(-count // batch_size) * batch_size


def test_process_many_keeps_no_image(pipeline):
    seen = []
    for image in itertools.islice(pipeline.process_many(Source(), batch_size=2), 9):
        gc.collect()
        assert sum(reference() is not None for reference in seen) <= 2  # of this batch, and the loop's own
        seen.append(weakref.ref(image.amplitude))
        del image


def test_process_many_batches_are_smaller_for_large_images(pipeline, monkeypatch):
    n_bytes = MEASUREMENTS[0].data.nbytes + 4 * len(pipeline.grid) * len(pipeline.range_m)
    monkeypatch.setattr(pipelines, "_MAX_BATCH_BYTES", n_bytes)
    source = Source()
    next(pipeline.process_many(source))
    assert source.given == 1


def test_process_many_yields_the_batches_before_a_measurement_it_refuses(pipeline):
    other = replace(MEASUREMENTS[3], settings=SHORT.replace(air=Air(temperature_c=30.0)))
    images = pipeline.process_many([*MEASUREMENTS[:3], other], batch_size=2)
    assert [next(images).stamp.sequence, next(images).stamp.sequence] == [0, 1]
    with pytest.raises(DataError, match="process it with its own settings"):
        next(images)


def test_process_many_refuses_arguments_at_once():
    with Pipeline(SHORT, "cpu", 1, predict=False) as pipeline:
        with pytest.raises(ArgumentError, match="batch_size is 0; use a whole number of at least 1"):
            pipeline.process_many([], batch_size=0)
        with pytest.raises(ArgumentError, match=r"measurements\[0\] is of type str; pass a "):
            next(pipeline.process_many(["rec.h5"]))
        with pytest.raises(ArgumentError, match="measurements is of type Measurement; pass a list"):
            next(pipeline.process_many(MEASUREMENTS[0]))
        assert list(pipeline.process_many([])) == []
    with pytest.raises(ArgumentError, match="the pipeline is closed"):
        pipeline.process_many([])
