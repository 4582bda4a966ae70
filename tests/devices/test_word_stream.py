"""Demodulation of words while they arrive: always the image of the whole measurement."""

import threading
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.block_receiver import BlockReceiver
from ertis_numba.devices.blocks import Instant, encode_block
from ertis_numba.settings import Processing, Recording
from tests.pages import python_in

N_SAMPLES = 32_768
SETTINGS = ertis.Settings(
    recording=Recording(n_samples=N_SAMPLES), processing=Processing(directions="2d:9", range_m=(0.3, 1.0))
)
NOW = Instant(0, 0, 0)


def words_of(seed):
    return np.random.default_rng(seed).integers(0, 2**32, N_SAMPLES, dtype=np.uint32)


@pytest.fixture(scope="module")
def pipeline():
    with ertis.Pipeline(SETTINGS, "cpu", predict=False) as made:
        yield made


def image_of(pipeline, words, stream=None, **options):
    return pipeline.process(ertis.Measurement(words, pipeline.settings), stream=stream, **options).amplitude


def add(stream, words, sizes):
    first = 0
    for size in sizes:
        stream.add(first, words[first : first + size])
        first += size


@pytest.mark.parametrize(
    "sizes",
    [
        [],
        [1],
        [N_SAMPLES],
        [N_SAMPLES - 1],
        [16_384, 16_384],
        [5120] * 6,
        [1, 7, 59, 61, 4093, 20_011],
        list(np.random.default_rng(5).integers(0, 900, 60)),
    ],
)
def test_image_has_the_same_bits_for_any_pieces(pipeline, sizes):
    words, stream = words_of(1), pipeline.stream()
    add(stream, words, sizes)
    np.testing.assert_array_equal(image_of(pipeline, words, stream), image_of(pipeline, words))


@pytest.mark.parametrize("changes", [{}, {"method": "paper"}, {"range_m": (0.1, 0.6)}, {"beamformer": "capon"}])
@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_image_has_the_same_bits_for_each_chain(device, changes):
    settings = SETTINGS.replace(processing=SETTINGS.processing.replace(**changes))
    with ertis.Pipeline(settings, device, predict=False) as pipeline:
        words, stream = words_of(2), pipeline.stream()
        for _ in range(2):  # The second measurement meets the signals of the first.
            add(stream, words, [9000, 9000, 9000])
            np.testing.assert_array_equal(image_of(pipeline, words, stream), image_of(pipeline, words))
            words = words_of(3)


def test_words_of_another_measurement_do_not_change_an_image(pipeline):
    words, other, stream = words_of(4), words_of(5), pipeline.stream()
    expected = image_of(pipeline, words)
    add(stream, other, [20_000])
    np.testing.assert_array_equal(image_of(pipeline, words, stream), expected)
    spoilt = words.copy()
    spoilt[12_345] ^= 1
    add(stream, spoilt, [20_000])
    np.testing.assert_array_equal(image_of(pipeline, words, stream), expected)
    add(stream, words, [20_000])
    stream.add(21_000, words[21_000:])  # A thousand words are missing.
    np.testing.assert_array_equal(image_of(pipeline, words, stream), expected)
    np.testing.assert_array_equal(image_of(pipeline, words, stream), expected)  # Nothing was added since.
    stream.add(0, np.concatenate([words, words]))
    np.testing.assert_array_equal(image_of(pipeline, words, stream), expected)


def test_signals_are_computed_as_words_arrive(pipeline, monkeypatch):
    demodulate, parts = pipeline._chain._demodulate, []  # noqa: SLF001  the only place where work is visible
    monkeypatch.setattr(type(demodulate), "__call__", lambda *_: pytest.fail("demodulated from the beginning"))
    part = type(demodulate).part
    monkeypatch.setattr(type(demodulate), "part", lambda self, *given: (parts.append(given[1]), part(self, *given)))
    words, stream = words_of(6), pipeline.stream()
    add(stream, words, [N_SAMPLES // 4, N_SAMPLES // 2])
    n_words, n_signals = 3 * N_SAMPLES // 4, demodulate.n_ready(3 * N_SAMPLES // 4)
    assert len(parts) == n_signals // 512 > 0
    assert n_signals - demodulate.n_ready(n_words - 1000) == 1000 // SETTINGS.decimation
    image_of(pipeline, words, stream)
    assert parts == list(range(0, demodulate.shape[1], 512))  # Each sample once.


@pytest.fixture
def near(monkeypatch):
    """Return a pipeline of near ranges, a list to which each computed image is added, and a clock that a test sets."""
    settings = SETTINGS.replace(processing=SETTINGS.processing.replace(range_m=(0.3, 0.6)))
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        images, clock = [], Clock()
        chain = type(pipeline._chain)  # noqa: SLF001  the only place where work is visible
        image = chain._image  # noqa: SLF001
        monkeypatch.setattr("ertis_numba.chain.word_stream.perf_counter", clock)

        def timed(*given, **options):
            images.append(given)
            image(*given, **options)
            clock.now_s += clock.image_s

        monkeypatch.setattr(chain, "_image", timed)
        yield pipeline, images, clock


class Clock:
    """Clock that a test sets, on which an image takes a constant time."""

    def __init__(self):
        self.now_s, self.image_s = 0.0, 0.0

    def __call__(self):
        return self.now_s


@pytest.mark.parametrize(
    ("word_s", "image_s", "is_early"),
    [(1e-6, 1e-3, True), (1e-6, 2.2e-3, False), (1e-7, 1e-3, False), (0.0, 1e-3, False)],
)
def test_image_of_near_ranges_is_finished_early_if_the_last_words_take_longer(near, word_s, image_s, is_early):
    pipeline, images, clock = near
    words = words_of(7)
    later = words.copy()
    later[30_000:] ^= 1  # The image depends on no later word.
    expected = image_of(pipeline, later)
    clock.image_s = image_s
    stream = pipeline.stream()
    images.clear()
    for first in range(0, 30_000, 2000):
        stream.add(first, words[first : first + 2000])
        assert len(images) == (is_early and first == 28_000)
        clock.now_s += word_s * 2000
    np.testing.assert_array_equal(image_of(pipeline, later, stream), expected)
    assert len(images) == 1


def test_image_is_not_finished_early_if_the_rate_of_words_is_unknown(near):
    pipeline, images, clock = near
    stream = pipeline.stream()
    images.clear()
    clock.now_s += 1.0
    add(stream, words_of(7), [30_000])
    assert not images


def test_number_of_threads_does_not_change_an_image(pipeline):
    words, stream = words_of(7), pipeline.stream()
    add(stream, words, [30_000])
    np.testing.assert_array_equal(image_of(pipeline, words, stream, threads=1), image_of(pipeline, words))


def test_words_may_be_added_while_another_thread_processes(pipeline):
    stream, measurements = pipeline.stream(), [words_of(seed) for seed in range(8, 12)]
    expected = [image_of(pipeline, words) for words in measurements]
    stopping = threading.Event()

    def disturb():
        while not stopping.is_set():
            add(stream, measurements[0], [3000] * 10)

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        for _ in range(5):
            for words, image in zip(measurements, expected, strict=True):
                np.testing.assert_array_equal(image_of(pipeline, words, stream), image)
    finally:
        stopping.set()
        thread.join()


def test_stream_of_another_pipeline_is_refused(pipeline):
    with (
        ertis.Pipeline(SETTINGS, "cpu", predict=False) as other,
        pytest.raises(ArgumentError, match="another pipeline; create one with stream"),
    ):
        image_of(pipeline, words_of(1), other.stream())


def test_stream_is_refused_by_a_pipeline_that_has_none(pipeline):
    settings = SETTINGS.replace(processing=SETTINGS.processing.replace(method="paper"))
    with ertis.Pipeline(settings, "numpy", predict=False) as other:
        words = words_of(1)
        with pytest.raises(ArgumentError, match="another pipeline; create one with stream"):
            image_of(other, words, pipeline.stream())
        np.testing.assert_array_equal(image_of(other, words, other.stream()), image_of(other, words))


@pytest.mark.parametrize("threads", [0, -1, 999])
def test_number_of_threads_is_checked_for_streams_and_finished_images(near, threads):
    pipeline, _, clock = near
    words, stream = words_of(7), pipeline.stream()
    for first in range(0, 32_000, 2000):
        stream.add(first, words[first : first + 2000])
        clock.now_s += 1e-3
    with pytest.raises(ArgumentError, match="threads"):
        image_of(pipeline, words, stream, threads=threads)
    with pytest.raises(ArgumentError, match="threads"):
        image_of(pipeline, words, pipeline.stream(), threads=threads)


def test_code_of_the_page_on_sensors_runs(pipeline, tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    page = Path(__file__).parents[2] / "docs" / "how-to" / "devices.md"
    (code,) = python_in(page.read_text("utf-8"))
    words = words_of(13)
    with ertis.Emulator([words], name="front") as device:
        for shown, here in (('"sensor"', "PORT"), ('ertis.Settings.from_preset("default_25_50")', "SETTINGS")):
            assert shown in code
            code = code.replace(shown, here)
        names = {"PORT": device.port, "SETTINGS": SETTINGS}
        exec(compile(code, str(page), "exec"), names)
    np.testing.assert_array_equal(names["block"].data, words)
    np.testing.assert_array_equal(names["image"].amplitude, image_of(pipeline, words))


class Collected:
    """Words as `on_words` reports them."""

    def __init__(self):
        self.words, self.begun = np.empty(0, np.uint32), 0

    def __call__(self, first, words):
        if first == 0:
            self.words, self.begun = np.empty(0, np.uint32), self.begun + 1
        assert first == len(self.words)
        assert len(words)
        self.words = np.concatenate([self.words, words])


@pytest.mark.parametrize("n_bytes", [1, 3, 7, 4095, 70_000, 10**6])
def test_receiver_reports_words_as_they_arrive(n_bytes):
    n_samples = 512 if n_bytes < 100 else N_SAMPLES
    measurements = [words_of(seed)[:n_samples] for seed in range(3)]
    data = b"".join(encode_block(number, words) for number, words in enumerate(measurements))
    collected, seen = Collected(), []
    receiver = BlockReceiver(n_samples, expected=0, shortest_s=1e-9, on_words=collected)
    for begin in range(0, len(data), n_bytes):
        before = collected.words
        for block in receiver.feed(data[begin : begin + n_bytes], NOW):
            seen.append(block)
            if n_bytes < 4 * n_samples:
                np.testing.assert_array_equal(before, block.data[: len(before)])
                assert len(before) >= n_samples - (n_bytes // 4 + 3)
    assert len(seen) == 3
    assert collected.begun == (3 if n_bytes < 4 * n_samples else 0)


def test_receiver_returns_a_complete_block_before_it_reports_words_of_the_next():
    measurements = [words_of(seed)[:512] for seed in range(2)]
    data = b"".join(encode_block(number, words) for number, words in enumerate(measurements))
    calls = []

    def failing(first, words):
        calls.append((first, len(words)))
        raise RuntimeError("the program is wrong")

    receiver = BlockReceiver(512, expected=0, shortest_s=1e-9, on_words=failing)
    (block,) = receiver.feed(data[: len(data) // 2 + 400], NOW)
    assert (block.counter, calls) == (0, [])
    with pytest.raises(RuntimeError, match="the program is wrong"):
        receiver.feed(data[len(data) // 2 + 400 : len(data) // 2 + 600], NOW)
    assert calls == [(0, (600 - 8) // 4)]
    (block,) = receiver.feed(data[len(data) // 2 + 600 :], NOW)
    np.testing.assert_array_equal(block.data, measurements[1])
    assert (receiver.lost, receiver.rejected.total(), receiver.pending) == (0, 0, 0)


def test_damaged_blocks_give_the_images_that_they_give_without_a_stream(pipeline):
    rng = np.random.default_rng(12)
    measurements = [words_of(seed) for seed in range(20, 26)]
    data = bytearray(b"".join(encode_block(number, words) for number, words in enumerate(measurements)))
    del data[150_000:150_007]  # The second block lacks bytes.
    data[300_000:300_000] = rng.bytes(13)  # The third has too many.
    data[500_000] ^= 0xFF  # A word of the fourth is wrong, which nothing can detect.
    stream = pipeline.stream()
    streamed = BlockReceiver(N_SAMPLES, shortest_s=1e-9, on_words=stream.add)
    plain = BlockReceiver(N_SAMPLES, shortest_s=1e-9)
    images = []
    for begin in range(0, len(data), 10_000):
        piece = bytes(data[begin : begin + 10_000])
        blocks, same = streamed.feed(piece, NOW), plain.feed(piece, NOW)
        assert [block.counter for block in blocks] == [block.counter for block in same]
        for block, other in zip(blocks, same, strict=True):
            images.append(image_of(pipeline, block.data, stream))
            np.testing.assert_array_equal(images[-1], image_of(pipeline, other.data))
    assert len(images) >= 3
    assert streamed.rejected == plain.rejected
