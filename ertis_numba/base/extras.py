"""Optional dependencies, which ``pip install 'ertis-numba[EXTRA]'`` installs."""

from collections.abc import Iterator
from contextlib import contextmanager

from ertis_numba.base.errors import ArgumentError, ErtisError

__all__ = ["extra"]


@contextmanager
def extra(name: str, need: str, kind: type[ErtisError] = ArgumentError) -> Iterator[None]:
    """Turn a failed import into an error that names its extra; ``need`` is like "metrics need prometheus-client"."""
    try:
        yield
    except ImportError as error:
        if error.name is not None and error.name.partition(".")[0] == "ertis_numba":
            raise  # a bug in this package, not a missing extra
        reason = " ".join(str(error).split())
        raise kind(f"{need} ({reason}); run \"pip install 'ertis-numba[{name}]'\"") from error
