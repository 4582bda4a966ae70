"""What is simulated, as frozen structures with TOML in and out.

Strengths and levels are relative to full scale: an amplitude of 1, or 0 dB, is a signal that would
keep all PDM bits at one value.
"""

from pathlib import Path

from ertis_numba import checks
from ertis_numba.documents import Document, Table
from ertis_numba.geometry import load_layout
from ertis_numba.settings import Settings

__all__ = ["DirectSound", "Electronics", "Point", "Scene", "load_scene"]

_HIGHEST_STRENGTH_DB = 120.0  # far beyond any overload; the bound catches amplitudes given for levels


class Point(Table, frozen=True, kw_only=True):
    """A reflector so small that it sends the call back alike in all directions.

    Attributes
    ----------
    azimuth_deg, elevation_deg : float
        In the sensor frame.
    range_m : float
        From the sensor's origin, where the emitter is.
    strength_db : float
        Level of the echo if reflector, emitter and microphone were 1 m apart. The amplitude of an
        echo is ``10 ** (strength_db / 20) / (r_tx r_rx)``, distances in metres.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    range_m: float
    strength_db: float = -20.0

    def __post_init__(self) -> None:
        checks.between("point.azimuth_deg", self.azimuth_deg, -180.0, 180.0)
        checks.between("point.elevation_deg", self.elevation_deg, -90.0, 90.0)
        checks.between("point.range_m", self.range_m, 1e-3, 1000.0)
        checks.between("point.strength_db", self.strength_db, -300.0, _HIGHEST_STRENGTH_DB)


class DirectSound(Table, frozen=True, kw_only=True):
    """What the microphones hear of the emitter beside them.

    Attributes
    ----------
    strength_db : float
        Level 1 m from the emitter; the amplitude is ``10 ** (strength_db / 20) / r``.
    """

    strength_db: float = -40.0

    def __post_init__(self) -> None:
        checks.between("direct_sound.strength_db", self.strength_db, -300.0, _HIGHEST_STRENGTH_DB)


class Electronics(Table, frozen=True, kw_only=True):
    """What the microphones add.

    Attributes
    ----------
    noise_dbfs : float, optional
        Root mean square of each microphone's white noise, over the whole band up to half of the PDM
        rate; none by default. In a band B it is lower by ``10 log10(pdm_rate / 2 B)`` decibels.
    modulator_order : int
        Order of the sigma-delta modulators, 1 to 4.
    dither : float
        Width of the uniform dither at the quantiser, full scale 1.
    """

    noise_dbfs: float | None = None
    modulator_order: int = 4
    dither: float = 0.5

    def __post_init__(self) -> None:
        if self.noise_dbfs is not None:
            checks.between("electronics.noise_dbfs", self.noise_dbfs, -300.0, 0.0)
        checks.whole("electronics.modulator_order", self.modulator_order, 1, 4)
        checks.between("electronics.dither", self.dither, 0.0, 2.0)


class Scene(Document, frozen=True, kw_only=True):
    """A sensor and what it hears: the whole content of a scene file.

    Attributes
    ----------
    seed : int
        Decides noise and dither. Measurements of one scene differ by their index alone.
    rate_hz : float
        Measurements per second.
    sensor : Settings
    electronics : Electronics
    direct_sound : DirectSound, optional
        None is heard by default.
    points : tuple of Point
    """

    seed: int = 0
    rate_hz: float = 20.0
    sensor: Settings = Settings()
    electronics: Electronics = Electronics()
    direct_sound: DirectSound | None = None
    points: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        checks.whole("seed", self.seed, 0)
        checks.between("rate_hz", self.rate_hz, 1e-6, 1e6)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    A layout file that it names is looked for beside it and written out, so that the scene depends on no
    other file.

    Raises
    ------
    SettingsError
        The file cannot be read or used.
    ArgumentError
        Its layout file cannot be read or used.
    """
    path = Path(path)
    scene = Scene.load(path)
    layout = scene.sensor.array.layout
    if scene.sensor.array.positions_m is None and Path(layout).suffix.lower() in {".toml", ".csv"}:
        array = load_layout(path.parent / layout).to_array()
        scene = scene.replace(sensor=scene.sensor.replace(array=array))
    return scene
