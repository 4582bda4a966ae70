"""Journals, which store measurements durably before any other use; the only package that imports sqlite3."""

from ertis_numba.journal._entries import JournalEntry, JournalKey, JournalSensor, require_same_settings
from ertis_numba.journal._journal import SUFFIX, Journal
from ertis_numba.journal._poses import JournalPose, PosesAround
from ertis_numba.journal._recovery import LOST
from ertis_numba.journal._tables import TABLES, VERSION, Column
from ertis_numba.journal._tally import TALLY
from ertis_numba.journal.storage_processes import SealingResult, seal_in_subprocess, sessions_in_recordings

__all__ = [
    "LOST",
    "SUFFIX",
    "TABLES",
    "TALLY",
    "VERSION",
    "Column",
    "Journal",
    "JournalEntry",
    "JournalKey",
    "JournalPose",
    "JournalSensor",
    "PosesAround",
    "SealingResult",
    "require_same_settings",
    "seal_in_subprocess",
    "sessions_in_recordings",
]
