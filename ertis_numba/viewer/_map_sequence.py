"""Acoustic maps of a recording, by the number of a measurement."""

from typing import Literal

from ertis_numba.frames import AcousticMap, Measurement
from ertis_numba.passive import AcousticCamera
from ertis_numba.storage import RecordingReader

__all__ = ["MapSequence"]


class MapSequence:
    """Acoustic maps of one sensor; call it with the number of a measurement.

    Every ``passive.averages`` measurements form a group, as in `AcousticCamera.process_many`. The map of a measurement
    is the mean of its group up to this measurement. Measurements in order are therefore processed once.
    """

    def __init__(self, reader: RecordingReader, *, device: Literal["auto", "cpu", "cuda", "numpy"]) -> None:
        self._reader = reader
        self._camera = AcousticCamera(reader.settings, device, check=False)
        self._next = 0  # Number of the measurement that continues the mean.

    def __call__(self, number: int) -> AcousticMap:
        """Return the map that ends with a measurement."""
        averages = self._camera.settings.passive.averages
        first = number - number % averages
        if not first < self._next <= number:
            self._camera.reset()
            self._next = first
        for each in range(self._next, number + 1):
            measurement = self._reader[each]
            # The air of each measurement may be measured; the delays of a map are those of the recording.
            self._camera.add(Measurement(measurement.data, self._camera.settings, measurement.stamp))
        self._next = number + 1
        return self._camera.map()

    @property
    def band_note(self) -> str | None:
        """Note on sound that the bands do not show, in all measurements so far."""
        return self._camera.band_note

    def close(self) -> None:
        """Free the memory of the device."""
        self._camera.close()
