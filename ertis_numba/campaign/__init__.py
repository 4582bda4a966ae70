"""Campaigns: processing of many recordings to energyscapes, on all cores or on a cluster.

Each recording becomes one output file, complete or not at all. An interrupted campaign therefore continues at the next
recording. Workers are independent processes: a crash affects only the recording in progress.
"""

from ertis_numba.campaign.campaign import Campaign
from ertis_numba.campaign.events import Event, RecordingEnded, RecordingProgress, RecordingStarted
from ertis_numba.campaign.recording_job import RecordingJob, prepare_recording
from ertis_numba.campaign.recordings import RecordingFile, find_recordings, output_paths
from ertis_numba.campaign.tasks import CampaignOptions

__all__ = [
    "Campaign",
    "CampaignOptions",
    "Event",
    "RecordingEnded",
    "RecordingFile",
    "RecordingJob",
    "RecordingProgress",
    "RecordingStarted",
    "find_recordings",
    "output_paths",
    "prepare_recording",
]
