"""What to make of measurements, and with what."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.network.addresses import DEFAULT_PUBLISH
from ertis_numba.network.keys import ServerKeys
from ertis_numba.settings import Settings

__all__ = ["ProcessingOptions"]


@dataclass(frozen=True, kw_only=True)
class ProcessingOptions:
    """What to make of measurements, and with what.

    Attributes
    ----------
    publish : str
        Address at which applications subscribe.
    keys : ServerKeys, optional
        Without them, on loopback only.
    processing : dict
        Fields of `ertis_numba.settings.Processing` that are to be other than a sensor says.
    max_error_db : float, optional
        Error that images may have, if other than a sensor says.
    device : {"auto", "cpu", "cuda", "numpy"}
    workers : int, optional
        Processes; one for each core, or one for a GPU, by default.
    threads : int, optional
        Of all workers together; all cores by default.
    deadline_s : float
        After which a worker that is not done with a measurement is killed.
    prepare_s : float
        After which it is killed if it is not ready for a sensor, the compilation of kernels included.
    dtype : {"float32", "float16"}
        Of images that are sent.
    quarantine : Path, optional
        Folder for measurements that two workers have died of.
    expected : Settings, optional
        Of a sensor that is likely to come: workers get ready for it before it does.
    cluster : str, optional
        Address of a dask scheduler whose workers are to be used instead of local ones.

    Raises
    ------
    ArgumentError
        One of them cannot be used.
    """

    publish: str = DEFAULT_PUBLISH
    keys: ServerKeys | None = None
    processing: dict[str, Any] = field(default_factory=dict)
    max_error_db: float | None = None
    device: str = "auto"
    workers: int | None = None
    threads: int | None = None
    deadline_s: float = 2.0
    prepare_s: float = 300.0
    dtype: Literal["float32", "float16"] = "float32"
    quarantine: Path | None = None
    expected: Settings | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        checks.choice("device", self.device, ("auto", "cpu", "cuda", "numpy"))
        checks.choice("dtype", self.dtype, ("float32", "float16"))
        checks.positive("deadline", self.deadline_s)
        checks.positive("prepare_s", self.prepare_s)
        for name in ("workers", "threads"):
            if (value := getattr(self, name)) is not None:
                checks.integer(name, value, 1, 256)
        if self.quarantine is not None and not self.quarantine.is_dir():
            raise ArgumentError(f"quarantine {self.quarantine} is no folder; make it first")
        self.applied(Settings())

    def applied(self, settings: Settings) -> Settings:
        """Return the settings of a sensor as measurements of it are to be processed.

        Raises
        ------
        ArgumentError
            They cannot be.
        """
        if self.processing:
            settings = settings.replace(processing=settings.processing.replace(**self.processing))
        if self.max_error_db is not None:
            settings = settings.replace(accuracy=settings.accuracy.replace(max_error_db=self.max_error_db))
        return settings
