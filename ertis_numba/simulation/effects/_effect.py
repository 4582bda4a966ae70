"""Declaration of an effect: its words, its estimate, and the places where it acts."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Call
from ertis_numba.simulation.arrivals import EchoPaths
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["AddedCalls", "Effect", "Sound"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AddedCalls:
    """Copies of a call in addition to the echoes.

    Attributes
    ----------
    call : Call
    delay_s : (path, mic) float64
        Delay from the start of the record, without the microphones' own delays.
    amplitude : (path, mic, frequency) float64
        Amplitude at each frequency, or one value for all, including the microphones' gains.
    sensor : int, optional
        Index of the sensor that emits the call, whose clock and transducer then apply.
    """

    call: Call
    delay_s: Floats
    amplitude: Floats
    sensor: int | None = None


class Sound(Protocol):
    """Sound that is added to the signals of all microphones."""

    def add_to(self, signals: Floats, first: int, /) -> None:
        """Add the sound in place to (mic, sample) signals, whose first sample has index ``first`` in the record."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Effect:
    """Effect on the sound of a scene.

    Most effects act by one of the functions below. The others act at a place of their own in `arrivals` or `engine`,
    which asks for them by name.

    Attributes
    ----------
    name : str
        Name in scenes and reports.
    about : str
        Description for users.
    equation, source, needed_if : str
        Model, its source, and the condition in words, for the documentation.
    estimate : callable, optional
        Returns the greatest change of the image in decibels, relative to the strongest amplitude at that range, but at
        least to the weakest reflector that the image shows. Returns None if nothing in the scene is subject to the
        effect. An indispensable effect has no estimate.
    indispensable : str
        Reason why every scene needs the effect; empty if it can be left out.
    requested : bool
        True if a scene has the effect only if one of its keys requests it, such as ``electronics.noise_dbfs``. It is
        then simulated even if no image shows it, because recordings contain it.
    changes_paths : bool
        True if it changes the paths of echoes.
    weakens : bool
        True if it never raises an amplitude.
    gain : callable, optional
        Returns factors on the amplitude of echoes, (path, mic, frequency) or broadcast to it, or None if it does not
        apply to these paths.
    microphones : callable, optional
        Returns factors on the sensitivity of the microphones, and their additional delays in seconds: both (mic,).
    calls : callable, optional
        Returns calls in addition to the echoes, given the snapshot, the active effects and the microphones' gains.
    sounds : callable, optional
        Returns other sounds, given the snapshot and the seed of the measurement.
    """

    name: str
    about: str
    equation: str
    source: str = ""
    needed_if: str
    estimate: Callable[[Sight], Estimate | None] | None = None
    indispensable: str = ""
    requested: bool = False
    changes_paths: bool = False
    weakens: bool = False
    gain: Callable[[EchoPaths], Floats | Complexes | None] | None = None
    microphones: Callable[[Snapshot], tuple[Floats, Floats]] | None = None
    calls: Callable[[Snapshot, AbstractSet[str], Floats], list[AddedCalls]] | None = None
    sounds: Callable[[Snapshot, tuple[int, ...]], list[Sound]] | None = None
