"""Every error this package raises on purpose, in one tree.

::

    ErtisError
    ├── ArgumentError (ValueError)       a value given by the caller cannot be used
    │   └── SettingsError                a settings file or structure cannot be used
    ├── DataError (ValueError)           a file or measurement does not hold what it should
    │   ├── DamagedError                 it is not what was written, and never will be
    │   ├── ForeignDataError             a file has links, filters, or data under several names or in other files
    │   ├── FormatVersionError           a file was written by a newer version
    │   ├── InUseError                   a journal belongs to another process
    │   └── NoRoomError                  a disk is too full, and nothing was written
    ├── DeviceError (RuntimeError)       the compute device asked for is not there
    ├── SonarError (OSError)             a sensor cannot be opened or does not answer as it should
    │   └── SonarGoneError               it was unplugged
    └── NetworkError (OSError)           another node cannot be reached or does not answer as it should
        └── RefusedError                 it does not let this one in, or not do what was asked

Each class also inherits the builtin that a caller would catch without knowing this package. Two warnings stand beside
them, both ``UserWarning``: ``ErrorBudgetWarning``, for images that may exceed their error budget, and
``CallMismatchWarning``, for echoes that do not match the call.
"""

__all__ = [
    "ArgumentError",
    "CallMismatchWarning",
    "DamagedError",
    "DataError",
    "DeviceError",
    "DiskFullError",
    "ErrorBudgetWarning",
    "ErtisError",
    "ForeignDataError",
    "FormatVersionError",
    "JournalInUseError",
    "NetworkError",
    "RefusedError",
    "SettingsError",
    "SonarDisconnectedError",
    "SonarError",
]


class ErtisError(Exception):
    """Base of all errors raised on purpose; its text is one line fit to show to a user."""


class ArgumentError(ErtisError, ValueError):
    """A value given by the caller cannot be used."""


class SettingsError(ArgumentError):
    """A settings file or structure cannot be used."""


class DataError(ErtisError, ValueError):
    """A file or a measurement does not hold what it should."""


class DamagedError(DataError):
    """What is in a file is not what was written; to read it again, as after a fault of the disk, does not help."""


class ForeignDataError(DataError):
    """A file has links, filters, or data under several names or in other files; this package writes no such file."""


class FormatVersionError(DataError):
    """A file was written by a newer version of this package."""


class JournalInUseError(DataError):
    """A journal belongs to another process: a capture that runs, or what seals it."""


class DiskFullError(DataError):
    """The disk has no room for the data; nothing was written."""


class DeviceError(ErtisError, RuntimeError):
    """The compute device asked for is not available."""


class SonarError(ErtisError, OSError):
    """A sensor cannot be opened, or does not answer as it should."""


class SonarDisconnectedError(SonarError):
    """A sensor was unplugged."""


class NetworkError(ErtisError, OSError):
    """Another node cannot be reached, or does not answer as it should."""


class RefusedError(NetworkError):
    """Another node does not let this one in, or does not do what was asked."""


class ErrorBudgetWarning(UserWarning):
    """Images may exceed the error budget that the pipeline was made for."""


class CallMismatchWarning(UserWarning):
    """Echoes are not those of the call that the settings name, so ranges in images are wrong."""
