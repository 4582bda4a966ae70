"""Association of the echoes of all sensors with the reflectors that cause them."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.confirmation import confirmation
from ertis_numba.fusion.echo_paths import EchoPaths
from ertis_numba.fusion.explanations import Search
from ertis_numba.fusion.heights import at_any_height
from ertis_numba.fusion.known_echoes import KnownEchoes
from ertis_numba.fusion.locating import Locator, median_of
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.fusion.sensor_echoes import PulseEchoes, SensorEchoes
from ertis_numba.fusion.sight import Viewers

__all__ = ["Reflectors"]

Floats = NDArray[np.float64]

_MANY_PAIRS: Final = 9  # If so many pairs should hear a reflector, more than those of two calls, one echo shows none.
_N_UNCLEAR: Final = 4  # Echoes of a reflector in space from which none needs to be clear (`SensorEchoes.is_clear`).
_STRONG: Final = 10 ** (-10.0 / 10)  # Reflectivity relative to the median, from which echoes need their own call.
_LOUD: Final = 10 ** (-6.0 / 10)  # Power relative to the strongest echo of an image, from which it proves a call.
_N_SEVERAL: Final = 3  # Echoes of a reflector that need no confirmation to explain pixels.


class Reflectors:
    """Reflectors that explain echoes jointly, each at the position that fits all of its echoes best.

    The call of any sensor may have caused an echo, and a flat array does not distinguish front and back. Each possible
    emitter of an echo yields a candidate: the place of a reflector. It predicts the paths and directions of the echoes
    at all other pairs of emitter and receiver. The candidate that fits the most echoes is accepted first and explains
    them; the next one must fit the remaining echoes. This is a greedy solution of the set cover problem. An own echo
    without confirmation is a reflector if the attribution of the images agrees. A foreign echo without confirmation has
    several explanations, and is discarded.

    ``bound`` (cell,) is the highest reflectivity that the images allow. ``reflectivity`` (reflector,) is the power of
    an echo at 1 m, ``radiated`` (reflector, emitter) that of each call relative to ahead, ``confirmed`` as in
    `ertis_numba.fusion.confirmation`. ``n_unexplained`` echoes, ``is_unexplained`` (echo,), have no reflector with
    others.
    """

    def __init__(
        self,
        echoes: Sequence[SensorEchoes],
        sensors: Sequence[MountedSensor],
        receivers: Mapping[int, Receiver],
        emitters: Mapping[int, Emitters],
        grid: PolarGrid,
        bound: NDArray[np.float32],
    ) -> None:
        flat = {number for number, receiver in receivers.items() if receiver.is_flat}
        self._viewers = Viewers(sensors, emitters, flat)
        self._receivers, self._is_planar = receivers, grid.is_planar
        self._echoes = heard = PulseEchoes.joined(echoes, len(sensors))
        rows = {each.receiver: np.flatnonzero(heard.receiver == each.receiver) for each in echoes}
        pulse_m, beam = np.ones((2, len(sensors)))
        for number, receiver in receivers.items():
            pulse_m[number], beam[number] = receiver.pulse_m, receiver.width
        self.locator = Locator(heard, self._viewers, pulse_m, beam)
        search = Search(heard, self._viewers, self.locator, grid, bound)
        found = search.found
        place_m = np.array([each.place_m for each in found]).reshape(-1, 3)
        paths = EchoPaths(
            self._viewers.sensor_m, self._viewers.ahead, rows, flat, heard.direction, heard.path_m, heard.power
        )
        sight = self._viewers.sight(place_m)
        reflectivity = np.array([each.reflectivity for each in found])
        sure = confirmation(paths, place_m, sight.gain, reflectivity, [each.echo for each in found])
        # A single echo of a reflector that many pairs should hear comes from elsewhere, unless it is that of a wall.
        n_echoes_of = np.array([len(each.echo) for each in found], np.int64)
        kept = (n_echoes_of > 1) | sure.is_wall | (sure.n_pairs < _MANY_PAIRS)
        is_clear = np.array([heard.is_clear[each.echo].any() for each in found], np.bool_)
        kept &= is_clear | (n_echoes_of >= _N_UNCLEAR) | grid.is_planar
        self.located = tuple(found[number] for number in np.flatnonzero(kept))
        self.position_m, self.radiated, self.confirmed = place_m[kept], sight.radiated[kept], sure.is_confirmed[kept]
        self.covariance_m2 = np.array([each.covariance_m2 for each in self.located]).reshape(-1, 3, 3)
        self.reflectivity = np.array([each.reflectivity for each in self.located])
        self.is_unexplained, self.n_unexplained = search.is_free, int(search.is_free.sum())

    def needs(self, number: int, silent: "Reflectors") -> bool:
        """Return True if an emitter is needed to explain strong echoes of its own sensor; ``silent`` is without it.

        Echoes of sound that walls reflect several times are missed and unexplained in any case, so that their number
        does not show that an emitter is silent. The image of its sensor then holds only echoes of other calls, which
        others explain, or which are weak for an own call.
        """
        least = _STRONG * median_of(self.reflectivity) if len(self.reflectivity) else 0.0
        own = [
            each.echo[(each.emitter == number) & (self._echoes.receiver[each.echo] == number)]
            for each in self.located
            if each.reflectivity > least
        ]
        return any(bool(silent.is_unexplained[echo].any()) for echo in own)

    def proves(self, number: int, silent: "Reflectors") -> bool:
        """Return True if loud echoes of a sensor show that it emits; ``silent`` is without its emitter.

        Fainter ones, which no other call explains, may be sound that several surfaces reflect.
        """
        heard = self._echoes
        is_own = heard.receiver == number
        is_loud = is_own & (heard.power > _LOUD * heard.power[is_own].max(initial=0.0)) & silent.is_unexplained
        return any(bool(is_loud[each.echo[each.emitter == number]].any()) for each in self.located)

    def placed(self) -> tuple[Floats, Floats]:
        """Return positions and covariances, in planar images those of reflectors at any height."""
        if not (self._is_planar and self.located):
            return self.position_m, self.covariance_m2
        axes_m2 = {number: each.axes_m2 for number, each in self._receivers.items()}
        return at_any_height(self.located, self._echoes, self._viewers.sensor_m, axes_m2)

    def own_emitters(self) -> frozenset[int]:
        """Return the emitters to whose calls the echoes of their own sensors are attributed."""
        own = [each.emitter[each.emitter == self._echoes.receiver[each.echo]].tolist() for each in self.located]
        return frozenset(number for each in own for number in each)

    @property
    def is_sure(self) -> NDArray[np.bool_]:
        """True for confirmed reflectors, and for those that several echoes locate: (reflector,) bool."""
        several = [len(each.echo) >= _N_SEVERAL for each in self.located]
        return np.asarray(self.confirmed | np.array(several, np.bool_))

    def known_echoes(self, receiver: int) -> KnownEchoes:
        """Return the echoes of the reflectors in the image of a receiver: located and predicted ones."""
        sight = self._viewers.sight(self.position_m)
        heard = self._echoes
        is_heard = np.isfinite(heard.path_m[heard.receiver == receiver]).any(axis=0)
        power = sight.gain[:, receiver] * self.reflectivity[:, None] * is_heard
        path_m = sight.apart_m[:, receiver, None] + sight.apart_m
        direction = np.repeat(sight.seen[:, receiver, None], power.shape[1], axis=1)
        for number, each in enumerate(self.located):
            here = heard.receiver[each.echo] == receiver
            echo, emitter = each.echo[here], each.emitter[here]
            path_m[number, emitter], direction[number, emitter] = heard.path_m[echo, emitter], heard.direction[echo]
            power[number, emitter] = heard.power[echo]
        reflector, emitter = np.nonzero(power > 0)
        return KnownEchoes(
            reflector,
            emitter,
            path_m[reflector, emitter],
            direction[reflector, emitter],
            power[reflector, emitter],
            sight.depth[reflector, receiver] > 0,
        )
