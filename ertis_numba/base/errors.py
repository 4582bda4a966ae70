"""Exceptions and warnings of this package.

::

    ErtisError
    ├── ArgumentError (ValueError)       a value given by the caller cannot be used
    │   └── SettingsError                a settings file or structure cannot be used
    ├── DataError (ValueError)           a file or measurement has unexpected content
    │   ├── DamagedError                 its content is damaged; reading it again does not help
    │   ├── ForeignDataError             a file has links, filters, or data under several names or in other files
    │   ├── FormatVersionError           a newer version wrote the file
    │   ├── JournalInUseError            a journal belongs to another process
    │   └── DiskFullError                a disk is full; nothing was written
    ├── DeviceError (RuntimeError)       the compute device is not available
    ├── SonarError (OSError)             a sensor cannot be opened or does not answer as it should
    │   └── SonarDisconnectedError       it was unplugged
    └── NetworkError (OSError)           another node cannot be reached or does not answer as it should
        └── RefusedError                 it denies access or rejects a request

Each class also inherits the built-in exception in brackets. Nine warnings, all ``UserWarning``, complete them:
``ErrorBudgetWarning`` for images that may exceed their error budget, ``CallMismatchWarning`` for echoes that do not
match the call, ``StartMismatchWarning`` for records that do not begin with the emission,
``LayoutMismatchWarning`` for echoes that do not match the layout, ``SampleFaultWarning`` for records with
dropouts, ``LayoutUnitWarning`` for files of positions that state no unit, ``CoarseGridWarning`` for directions that
miss sources between them,
``OutsideBandsWarning`` for sound that the bands of acoustic maps leave out, and ``PoseWarning`` for files of poses
with doubtful rows, and poses that are hardly those of a platform.
"""

__all__ = [
    "ArgumentError",
    "CallMismatchWarning",
    "CoarseGridWarning",
    "DamagedError",
    "DataError",
    "DeviceError",
    "DiskFullError",
    "ErrorBudgetWarning",
    "ErtisError",
    "ForeignDataError",
    "FormatVersionError",
    "JournalInUseError",
    "LayoutMismatchWarning",
    "LayoutUnitWarning",
    "NetworkError",
    "OutsideBandsWarning",
    "PoseWarning",
    "RefusedError",
    "SampleFaultWarning",
    "SettingsError",
    "SonarDisconnectedError",
    "SonarError",
    "StartMismatchWarning",
]


class ErtisError(Exception):
    """Base class of all exceptions of this package; the message is one line that can be shown to users."""


class ArgumentError(ErtisError, ValueError):
    """A value given by the caller cannot be used."""


class SettingsError(ArgumentError):
    """A settings file or structure cannot be used."""


class DataError(ErtisError, ValueError):
    """A file or a measurement has unexpected content."""


class DamagedError(DataError):
    """The content of a file is damaged; reading it again does not help."""


class ForeignDataError(DataError):
    """A file has links, filters, or data under several names or in other files; this package writes no such file."""


class FormatVersionError(DataError):
    """A file was written by a newer version of this package."""


class JournalInUseError(DataError):
    """A journal is in use by another process, such as a running capture or its sealing."""


class DiskFullError(DataError):
    """The disk has no room for the data; nothing was written."""


class DeviceError(ErtisError, RuntimeError):
    """The compute device is not available."""


class SonarError(ErtisError, OSError):
    """A sensor cannot be opened, or does not answer as it should."""


class SonarDisconnectedError(SonarError):
    """A sensor was unplugged."""


class NetworkError(ErtisError, OSError):
    """Another node cannot be reached, or does not answer as it should."""


class RefusedError(NetworkError):
    """Another node denies access or rejects a request."""


class ErrorBudgetWarning(UserWarning):
    """Images may exceed the error budget of their pipeline."""


class CallMismatchWarning(UserWarning):
    """Echoes do not match the call in the settings, so that ranges in images are wrong."""


class StartMismatchWarning(UserWarning):
    """Direct sound arrives at another time than from the emitter, so that ranges in images are wrong."""


class LayoutMismatchWarning(UserWarning):
    """Echoes do not match the layout in the settings, so that directions in images are wrong."""


class SampleFaultWarning(UserWarning):
    """Samples of a record are missing, so that echoes may be missing in images, or too wide."""


class LayoutUnitWarning(UserWarning):
    """A file of microphone positions states no unit, and its numbers may be millimetres or metres."""


class CoarseGridWarning(UserWarning):
    """Directions are so far apart that acoustic maps show sources between them too weak, or elsewhere."""


class OutsideBandsWarning(UserWarning):
    """Sound outside of the bands of acoustic maps is louder than that inside."""


class PoseWarning(UserWarning):
    """Poses are doubtful, such as those of a camera, so that a map may be wrong."""
