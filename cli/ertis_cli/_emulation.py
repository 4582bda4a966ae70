"""Samples of emulated sensors: rendered for the call that a sensor received, or replayed from a recording."""

import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ertis_numba.devices.emulator import DeviceConfig
    from ertis_numba.settings import Call, Recording
    from ertis_numba.simulation import Scene
    from ertis_numba.simulation.engine import Engine
    from ertis_numba.storage import RecordingReader

__all__ = ["Replayed", "SceneRenderer"]


class _SensorConfig(NamedTuple):
    """Settings that the host can change: call and recording."""

    call: "Call"
    recording: "Recording"


class SceneRenderer:
    """Renderer of the measurements of a scene's sensors, each when it is first needed."""

    def __init__(self, scene: "Scene") -> None:
        self._scene = scene
        self._configs = {sensor.name: _SensorConfig(sensor.call, sensor.recording) for sensor in scene.sensors}
        self._engines: dict[tuple[str, bool], Engine] = {}
        self._words: dict[tuple[str, bool, int], NDArray[np.uint32]] = {}
        self._turn = threading.Lock()

    def refusal(self, name: str, config: "DeviceConfig") -> str:
        """Render for this configuration from now on; return the reason if that is impossible, or an empty text."""
        from ertis_numba.base.errors import ArgumentError
        from ertis_numba.settings import PRESETS, Settings

        sensor = self._scene.sensor(name)
        calls = [sensor.call, *(Settings.from_preset(preset).call for preset in PRESETS)]
        call = next((each for each in calls if config.holds(each)), None)
        try:
            call = call or config.call()
        except ArgumentError as error:
            return f"{name} received a call that cannot be rendered, and does not measure: {error}"
        recording = sensor.recording.replace(n_samples=config.n_samples, sample_rate_hz=config.pdm_rate_hz)
        with self._turn:
            if self._configs[name] != (wanted := _SensorConfig(call, recording)):
                self._configs[name] = wanted
                self._engines, self._words = {}, {}
        return ""

    def of(self, name: str, *, active: bool) -> "Sequence[NDArray[np.uint32]]":
        """Return the measurements of a sensor; unless ``active``, all sensors are silent."""
        return _Words(self, name, active=active)

    def words(self, name: str, index: int, *, active: bool) -> "NDArray[np.uint32]":
        """Return the samples of a measurement as words."""
        active = active and self.emits
        key = name, active, index % self._scene.count
        with self._turn:
            if key not in self._words:
                self._words[key] = self._engine(name, active=active).render(key[2]).data
            return self._words[key]

    @property
    def emits(self) -> bool:
        """True if a sensor of the scene emits its call; otherwise, all measurements are without emission."""
        return not all(sensor.emitter.silent for sensor in self._scene.sensors)

    @property
    def count(self) -> int:
        """Number of measurements of each sensor, after which they repeat."""
        return self._scene.count

    def _engine(self, name: str, *, active: bool) -> "Engine":
        if (name, active) not in self._engines:
            from ertis_numba.settings import Processing, fit_ranges
            from ertis_numba.simulation.effects import EFFECTS
            from ertis_numba.simulation.engine import Engine

            effects = frozenset(effect for effect in EFFECTS if self._scene.effects.get(effect, True))
            scene = self._scene.replace(
                sensors=tuple(
                    sensor.replace(
                        **self._configs[sensor.name]._asdict(),
                        processing=fit_ranges(
                            Processing(), self._configs[sensor.name].recording, self._configs[sensor.name].call
                        ),
                        emitter=sensor.emitter if active else sensor.emitter.replace(silent=True),
                    )
                    for sensor in self._scene.sensors
                )
            )
            self._engines[name, active] = Engine(scene, scene.sensor(name), effects)
        return self._engines[name, active]


class _Words(Sequence["NDArray[np.uint32]"]):
    def __init__(self, renderer: SceneRenderer, name: str, *, active: bool) -> None:
        self._renderer, self._name, self._active = renderer, name, active

    def __len__(self) -> int:
        return self._renderer.count

    def __getitem__(self, index: Any) -> Any:
        return self._renderer.words(self._name, index, active=self._active)


class Replayed(Sequence["NDArray[np.uint32]"]):
    """Samples of a recording, read on demand."""

    def __init__(self, recording: "RecordingReader") -> None:
        self._recording = recording
        self._behaviours = [stamp.behaviour for stamp in recording.stamps()]
        self._reported: set[bool] = set()  # Requested behaviours whose difference was reported.

    def __len__(self) -> int:
        return len(self._recording)

    def __getitem__(self, index: Any) -> Any:
        return self._recording[index].data

    def difference(self, index: int, active: bool) -> str:  # noqa: FBT001 - a callback of Emulator
        """Return a message if a measurement differs from the requested behaviour, once for each; else an empty text."""
        requested, recorded = ("active" if active else "passive"), self._behaviours[index]
        if recorded in {requested, "unknown"} or active in self._reported:
            return ""
        self._reported.add(active)
        remedy = "with --passive" if active else "without --passive"
        return (
            f"{self._recording.sensor}: the requested measurements are {requested}, but those of the recording are "
            f"{recorded} and cannot change; capture {remedy}, or emulate the scene"
        )

    def refusal(self, name: str, config: "DeviceConfig") -> str:
        """Return the reason if the recording does not match this configuration, or an empty text."""
        call, recording = self._recording.settings.call, self._recording.settings.recording
        fits = (
            config.holds(call)
            and config.n_samples <= recording.n_samples
            and config.pdm_rate_hz == recording.sample_rate_hz
        )
        if fits:
            return ""
        return (
            f"{name} was recorded with a call of {_described(call)} and {recording.n_samples} samples at "
            f"{recording.sample_rate_hz / 1e6:g} MHz. It received other settings and does not measure; "
            f"start 'ertis capture' with {_remedy(call, recording)}"
        )


def _remedy(call: "Call", recording: "Recording") -> str:
    from ertis_numba.settings import PRESETS, Settings

    presets: Mapping[str, Settings] = {name: Settings.from_preset(name) for name in PRESETS}
    fitting = [name for name, each in presets.items() if (each.call, each.recording) == (call, recording)]
    return f"--preset {fitting[0]}" if fitting else "--settings with those"


def _described(call: "Call") -> str:
    return f"{call.start_frequency_hz / 1e3:g} to {call.stop_frequency_hz / 1e3:g} kHz in {1e3 * call.duration_s:g} ms"
