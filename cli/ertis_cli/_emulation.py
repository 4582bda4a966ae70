"""Words of emulated sensors: rendered for the call that a sensor was given, or replayed from a recording."""

import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ertis_numba.devices.emulator import Demand
    from ertis_numba.settings import Call, Recording
    from ertis_numba.simulation import Scene
    from ertis_numba.simulation.engine import Engine
    from ertis_numba.storage import RecordingReader

__all__ = ["Replayed", "Stage"]


class _Told(NamedTuple):
    """Part of the settings that a sensor was told."""

    call: "Call"
    recording: "Recording"


class Stage:
    """Measurements of a scene's sensors, rendered when they are first needed.

    All effects are simulated, except those that the scene switches off. This takes longer than rendering the effects
    that matter, but much less than finding out which ones do.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: "Scene") -> None:
        self._scene = scene
        self._told = {sensor.name: _Told(sensor.call, sensor.recording) for sensor in scene.sensors}
        self._engines: dict[tuple[str, bool], Engine] = {}
        self._words: dict[tuple[str, bool, int], NDArray[np.uint32]] = {}
        self._turn = threading.Lock()

    def refusal(self, name: str, demand: "Demand") -> str:
        """Render for what a sensor was told from now on; return why that is impossible, or an empty text."""
        from ertis_numba.settings import PRESETS, Settings

        sensor = self._scene.sensor(name)
        calls = [sensor.call, *(Settings.from_preset(preset).call for preset in PRESETS)]
        call = next((each for each in calls if demand.holds(each)), None)
        if call is None:
            return (
                f"{name} was given a call that is neither a preset's nor its scene's ({_described(sensor.call)}). It "
                "measures nothing; give 'ertis capture' a --preset, or --settings with the scene's call"
            )
        recording = sensor.recording.replace(n_samples=demand.n_samples, sample_rate_hz=demand.pdm_rate_hz)
        with self._turn:
            if self._told[name] != (told := _Told(call, recording)):
                self._told[name] = told
                self._engines, self._words = {}, {}
        return ""

    def of(self, name: str, *, active: bool) -> "Sequence[NDArray[np.uint32]]":
        """Return the measurements of a sensor, with all sensors silent if they are not active."""
        return _Words(self, name, active=active)

    def words(self, name: str, index: int, *, active: bool) -> "NDArray[np.uint32]":
        """Return the words of a measurement."""
        key = name, active, index % self._scene.count
        with self._turn:
            if key not in self._words:
                self._words[key] = self._engine(name, active=active).render(key[2]).words
            return self._words[key]

    @property
    def count(self) -> int:
        """Number of measurements of each sensor, after which they repeat."""
        return self._scene.count

    def _engine(self, name: str, *, active: bool) -> "Engine":
        if (name, active) not in self._engines:
            from ertis_numba.settings import Processing, suit_ranges
            from ertis_numba.simulation.engine import Engine
            from ertis_numba.simulation.names import EFFECTS

            effects = frozenset(effect for effect in EFFECTS if self._scene.effects.get(effect, True))
            scene = self._scene.replace(
                sensors=tuple(
                    sensor.replace(
                        **self._told[sensor.name]._asdict(),
                        processing=suit_ranges(
                            Processing(), self._told[sensor.name].recording, self._told[sensor.name].call
                        ),
                        emitter=sensor.emitter if active else sensor.emitter.replace(silent=True),
                    )
                    for sensor in self._scene.sensors
                )
            )
            self._engines[name, active] = Engine(scene, scene.sensor(name), effects)
        return self._engines[name, active]


class _Words(Sequence["NDArray[np.uint32]"]):
    def __init__(self, stage: Stage, name: str, *, active: bool) -> None:
        self._stage, self._name, self._active = stage, name, active

    def __len__(self) -> int:
        return self._stage.count

    def __getitem__(self, index: Any) -> Any:
        return self._stage.words(self._name, index, active=self._active)


class Replayed(Sequence["NDArray[np.uint32]"]):
    """Words of a recording, read when they are needed."""

    def __init__(self, recording: "RecordingReader") -> None:
        self._recording = recording

    def __len__(self) -> int:
        return len(self._recording)

    def __getitem__(self, index: Any) -> Any:
        return self._recording[index].words

    def refusal(self, name: str, demand: "Demand") -> str:
        """Return why the recording is no answer to what the sensor was told, or an empty text."""
        call, recording = self._recording.settings.call, self._recording.settings.recording
        fits = (
            demand.holds(call)
            and demand.n_samples <= recording.n_samples
            and demand.pdm_rate_hz == recording.sample_rate_hz
        )
        if fits:
            return ""
        return (
            f"{name} was recorded with a call of {_described(call)} and {recording.n_samples} samples at "
            f"{recording.sample_rate_hz / 1e6:g} MHz. It was told otherwise, and measures nothing; give "
            f"'ertis capture' {_remedy(call, recording)}"
        )


def _remedy(call: "Call", recording: "Recording") -> str:
    from ertis_numba.settings import PRESETS, Settings

    presets: Mapping[str, Settings] = {name: Settings.from_preset(name) for name in PRESETS}
    fitting = [name for name, each in presets.items() if (each.call, each.recording) == (call, recording)]
    return f"--preset {fitting[0]}" if fitting else "--settings with those"


def _described(call: "Call") -> str:
    return f"{call.start_frequency_hz / 1e3:g} to {call.stop_frequency_hz / 1e3:g} kHz in {1e3 * call.duration_s:g} ms"
