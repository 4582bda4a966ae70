"""Settings small enough for the slow CUDA simulator, and the processing plans to test with them."""

from ertis_numba.settings import Accuracy, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS

TINY = Settings(
    array=Array(layout="line", positions_m=tuple((0.0, 0.004 * mic, 0.0) for mic in range(2)), word_bits=8),
    call=Call(duration_s=3e-4),
    recording=Recording(n_samples=12_288),
    processing=Processing(directions="2d:9", range_m=(0.25, 0.38), range_decimation=50, decimation=10),
)
DIRECT = Accuracy(
    max_error_db=-20.0,
    precision="float32",
    oversampling=2,
    delay_taps=2,
    beam_taps=0,
    beam_density=2.0,
    stopband_attenuation_db=40.0,
    focal_zones=1,
)
NODES = DIRECT.replace(beam_taps=2, beam_density=3.0)
PLANS = {
    # Settings, and the largest difference in dB between the images of CPU and GPU. In single precision the order of
    # sums differs; with 16 bits some numbers round the other way.
    "float32": (TINY.replace(accuracy=DIRECT), -120),
    "float32, nodes": (TINY.replace(accuracy=NODES), -120),
    "int16": (TINY.replace(accuracy=DIRECT.replace(precision="int16")), -100),
    "int16, nodes": (TINY.replace(accuracy=NODES.replace(precision="int16")), -90),
    "taps of 32 bits": (TINY.replace(accuracy=DIRECT.replace(stopband_attenuation_db=80.0)), -120),
    "two zones": (
        TINY.replace(
            processing=TINY.processing.replace(wavefront="spherical"),
            accuracy=DIRECT.replace(focal_zones=2),
        ),
        -120,
    ),
    "phase shifts": (TINY.replace(accuracy=DIRECT.replace(oversampling=1, delay_taps=0)), -110),
    "phase shifts, two zones": (
        TINY.replace(
            processing=TINY.processing.replace(wavefront="spherical", directions="2d:3"),
            accuracy=DIRECT.replace(oversampling=1, delay_taps=0, focal_zones=2),
        ),
        -110,
    ),
    "delay matrix": (
        TINY.replace(
            processing=TINY.processing.replace(
                directions="2d:3", delay_matrix=((0.0, 5.5), (1.0, 1.0), (4.0, -2.25)), delay_rate_hz=450e3
            ),
            accuracy=DIRECT.replace(oversampling=1, delay_taps=0),
        ),
        -110,
    ),
    "own filter": (
        TINY.replace(
            processing=TINY.processing.replace(directions="2d:3", pre_filter=(0.25, 0.5, 0.25)), accuracy=DIRECT
        ),
        -120,
    ),
    "cleaned": (
        TINY.replace(
            processing=TINY.processing.replace(directions="2d:5", clean_within_db=1.0, clean_above_mean_db=0.5),
            accuracy=DIRECT,
        ),
        -120,
    ),
    "array weights": (
        TINY.replace(
            processing=TINY.processing.replace(directions="2d:3", array_weights=(1.0, 0.25)),
            accuracy=DIRECT,
        ),
        -120,
    ),
}
ROWS = TINY.replace(
    array=Array(
        layout="rows",
        positions_m=tuple((0.0, 0.004 * mic, 0.006 * row) for row in range(2) for mic in range(4)),
        word_bits=8,
    ),
    accuracy=NODES.replace(precision="int16", row_beams=True),
    processing=TINY.processing.replace(directions="3d:6"),
)
PLANS["rows"] = ROWS, -90
PLANS["rows, two zones"] = (
    ROWS.replace(
        processing=ROWS.processing.replace(wavefront="spherical"), accuracy=ROWS.accuracy.replace(focal_zones=2)
    ),
    -90,
)
PLANS["paper"] = (
    TINY.replace(
        recording=Recording(n_samples=4_096),
        processing=TINY.processing.replace(method="paper", directions="2d:3", range_m=(0.08, 0.14)),
    ),
    -120,
)
for _beamformer, _weighting in ADAPTIVE_COMBINATIONS:
    PLANS[f"{_beamformer}, {_weighting}"] = (
        TINY.replace(
            processing=TINY.processing.replace(beamformer=_beamformer, weighting=_weighting, directions="2d:3"),
            accuracy=DIRECT.replace(oversampling=8, delay_taps=1),
        ),
        -110,
    )
for _name, _processing, _accuracy in (
    ("dmas", {"beamformer": "dmas"}, {}),
    ("coherence factor", {"weighting": "coherence_factor"}, {"beam_taps": 2, "beam_density": 3.0}),
    ("both", {"beamformer": "dmas", "weighting": "coherence_factor"}, {}),
):
    PLANS[f"streams of {_name}"] = (
        TINY.replace(
            processing=TINY.processing.replace(**_processing, directions="2d:5"),
            accuracy=DIRECT.replace(precision="int16", oversampling=4, max_error_db=0.0, **_accuracy),
        ),
        -60,
    )
PLANS["streams, two zones"] = (
    TINY.replace(
        processing=TINY.processing.replace(weighting="coherence_factor", directions="2d:3", wavefront="spherical"),
        accuracy=DIRECT.replace(precision="int16", oversampling=4, max_error_db=0.0, focal_zones=2),
    ),
    -60,
)
