"""Options of image processing."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ertis_numba.base import checks
from ertis_numba.base.constants import IMAGE_DTYPES, ImageDtype
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.costs import PLAN_COSTS, PlanCosts
from ertis_numba.geometry import direction_grid
from ertis_numba.network.addresses import DEFAULT_PUBLISH
from ertis_numba.network.keys import ServerKeys
from ertis_numba.settings import ExcludedChannels, Settings

__all__ = ["ProcessingOptions"]


@dataclass(frozen=True, kw_only=True)
class ProcessingOptions:
    """Options of image processing."""

    publish: str = DEFAULT_PUBLISH  # address for applications; without keys, only on loopback
    keys: ServerKeys | None = None
    processing: dict[str, Any] = field(default_factory=dict)  # fields of `Processing` that override the sensor's own
    max_error_db: float | None = None  # error budget of images; the sensor's own by default
    without: ExcludedChannels = field(default_factory=ExcludedChannels)  # channels to exclude, of all or some sensors
    device: str = "auto"
    plan: PlanCosts = "nominal"  # as for `Pipeline`
    workers: int | str | None = None  # processes; one for each core, or one for a GPU; or a dask scheduler's address
    threads: int | None = None  # of all workers together; all cores by default
    deadline_s: float = 2.0  # after that, the worker of a measurement is killed
    prepare_s: float = 300.0  # includes the compilation of kernels for a sensor
    dtype: ImageDtype = "float32"  # of published images
    quarantine: Path | None = None  # dead-letter folder, for measurements that made two workers fail
    expected: Settings | None = None  # of a likely sensor, to prepare for in advance

    def __post_init__(self) -> None:
        checks.choice("plan", self.plan, PLAN_COSTS)
        checks.choice("device", self.device, ("auto", "cpu", "cuda", "numpy"))
        checks.choice("dtype", self.dtype, IMAGE_DTYPES)
        checks.positive("deadline", self.deadline_s)
        checks.positive("prepare_s", self.prepare_s)
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if name == "workers" and isinstance(value, str):
                checks.scheduler(name, value)
            elif value is not None:
                checks.integer(name, value, 1, 256)
        if self.quarantine is not None and not self.quarantine.is_dir():
            raise ArgumentError(f"quarantine folder {self.quarantine} does not exist; create it first")
        applied = self.applied(Settings())
        if "directions" in self.processing:
            direction_grid(applied.processing)

    def applied(self, settings: Settings, sensor: str = "") -> Settings:
        """Return a sensor's settings with these options applied."""
        settings = self.without.applied(settings, sensor)
        if self.processing:
            settings = settings.replace(processing=settings.processing.replace(**self.processing))
        if self.max_error_db is not None:
            settings = settings.replace(accuracy=settings.accuracy.replace(max_error_db=self.max_error_db))
        return settings
