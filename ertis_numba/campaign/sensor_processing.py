"""Processing of one sensor's measurements into a file."""

import itertools
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from ertis_numba.analysis.health import ARRAY_FAULTS, Health
from ertis_numba.analysis.health.kinds import DISABLE
from ertis_numba.analysis.sample_faults import SampleFaults
from ertis_numba.base.errors import DataError
from ertis_numba.campaign.attitudes import Attitudes
from ertis_numba.campaign.echo_measurements import EchoMeasurements
from ertis_numba.campaign.tasks import MAX_WAITING_BYTES
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings
from ertis_numba.storage import EnergyscapeWriter

if TYPE_CHECKING:
    from ertis_numba.pipeline.prediction import Prediction

__all__ = ["SensorProcessing", "describe_faults", "require_same_air"]

_SLOW_MS: Final = 500.0  # Compilation takes some seconds.


def describe_faults(name: str, report: Health, sensor: str = "") -> str:
    """Return the faulty microphones with the remedy, for one of several sensors, in a line; empty if there are none."""
    elsewhere = {"shifted record", *ARRAY_FAULTS}
    report = replace(report, findings=tuple(item for item in report.findings if item.fault not in elsewhere))
    if not report.faults:
        return ""
    if report.record_faults:
        details = "; ".join(f"{item.fault}: {item.detail or item.measured}" for item in report.record_faults)
        remedy = report.record_faults[0].remedy
        return f"{name} has faults in its recording ({details}); {remedy}, or see 'ertis info --health'"
    every = all(channel.faults for channel in report.channels)
    remedies = dict.fromkeys(item.remedy for item in report.findings)
    remedy = "check its cable and supply" if every else next(iter(remedies))
    if remedy == DISABLE:
        channels = sorted({channel.channel for channel in report.channels if channel.faults})
        remedy = f"exclude them with --without {sensor and f'{sensor}:'}{','.join(map(str, channels))}"
    return f"{name} has faulty microphones ({report.verdict()}); {remedy}, or see 'ertis info --health'"


class SensorProcessing:
    """Pipeline of one sensor, its predictions, and the time of each measurement."""

    # `batch` is reduced to `max_bytes` of waiting images. `prediction` is None before the first image.

    def __init__(
        self,
        pipeline: Pipeline,
        *,
        batch: int,
        max_bytes: float | None = None,
        attitudes: Attitudes | None = None,
    ) -> None:
        self.pipeline = pipeline
        self._attitudes = attitudes
        self.times_ms: list[float] = []
        self.reported: dict[str, Any] = {}
        self.prediction: Prediction | None = None
        self.call_warning = self.start_warning = self.layout_warning = self.samples_warning = ""
        self.is_first_only = False
        image_bytes = 4 * len(pipeline.grid) * len(pipeline.range_m)
        self._size = max(1, min(batch, int((max_bytes or MAX_WAITING_BYTES) / image_bytes)))

    def with_pipeline_settings(self, measurement: Measurement) -> Measurement:
        """Return a measurement with the settings of the pipeline, which may correct its array, call or air."""
        return replace(measurement, settings=self.pipeline.settings)

    def write(self, recording: EchoMeasurements, writer: EnergyscapeWriter) -> Iterator[None]:
        """Process a recording and write its images, all with its air unless settings replace it; yield after each."""
        settings = self.pipeline.settings
        as_recorded = settings.air == recording.settings.air
        measurements, faults = iter(recording), SampleFaults()
        while group := list(itertools.islice(measurements, self._size)):
            if as_recorded:
                for measurement in group:
                    require_same_air(measurement, settings)
            taken = [self.with_pipeline_settings(measurement) for measurement in group]
            for measurement in taken:
                faults.add(measurement)
            is_first = not self.times_ms
            images = self._processed(taken)
            if is_first and self.times_ms[0] > _SLOW_MS:  # The first call may have compiled kernels.
                self.times_ms = []
                self._processed(taken[:2])
                self.times_ms = [self.times_ms[0]] * len(group)
            images.reverse()
            while images:  # Written images are released: on a GPU, the next batch needs their memory.
                writer.write(images.pop())
                yield
        if recording.recording.truth is None:  # Simulated measurements without noise are alike.
            self.samples_warning = faults.note()
            self.is_first_only = faults.is_first_only
            writer.note_samples(recording.sensor, self.samples_warning)

    def _processed(self, measurements: Sequence[Measurement]) -> list[Energyscape]:
        start_s = time.perf_counter()
        if self._attitudes is not None:
            attitudes = map(self._attitudes, measurements)
            images = [
                self.pipeline.process(each, attitude_xyzw=attitude)
                for each, attitude in zip(measurements, attitudes, strict=True)
            ]
        elif len(measurements) == 1:
            images = [self.pipeline.process(measurements[0])]
        else:
            images = self.pipeline.process_batch(measurements)
        self.times_ms += [1000 * (time.perf_counter() - start_s) / len(images)] * len(images)
        return images

    def report(self) -> dict[str, Any]:
        """Return the report of ``--json``."""
        return {
            "measurements": len(self.times_ms),
            "directions": len(self.pipeline.grid),
            "ranges": len(self.pipeline.range_m),
            "range_m": [round(float(self.pipeline.range_m[index]), 4) for index in (0, -1)],
            "median_ms": round(statistics.median(self.times_ms), 3),
            **(self.prediction.as_dict() if self.prediction else {}),
            **({"call_warning": self.call_warning} if self.call_warning else {}),
            **({"start_warning": self.start_warning} if self.start_warning else {}),
            **({"layout_warning": self.layout_warning} if self.layout_warning else {}),
            **({"samples_warning": self.samples_warning} if self.samples_warning else {}),
            **self.reported,
        }


def require_same_air(measurement: Measurement, settings: Settings) -> None:
    """Refuse a measurement in other air, because its ranges and delays would differ from those of the others."""
    came, wanted = measurement.settings.air, settings.air
    if came != wanted:
        raise DataError(
            f"measurement {measurement.stamp.sequence} was taken at {came.temperature_c:g} °C, "
            f"{came.humidity_percent:g} %, {came.pressure_pa:g} Pa, others at {wanted.temperature_c:g} °C, "
            f"{wanted.humidity_percent:g} %, {wanted.pressure_pa:g} Pa; set one air for all of them (settings)"
        )
