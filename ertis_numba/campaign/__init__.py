"""Campaigns: processing of many recordings to energyscapes, on all cores or on a cluster.

Each recording becomes one output file, complete or not at all. An interrupted campaign therefore continues at the next
recording. Workers are independent processes: a crash affects only the recording in progress.
"""

from ertis_numba.campaign.campaign import Campaign
from ertis_numba.campaign.events import Advanced, Begun, Event, RecordingEnded
from ertis_numba.campaign.making import Making, making
from ertis_numba.campaign.orders import CampaignOptions
from ertis_numba.campaign.recordings import Source, find, outputs

__all__ = [
    "Advanced",
    "Begun",
    "Campaign",
    "CampaignOptions",
    "Event",
    "Making",
    "RecordingEnded",
    "Source",
    "find",
    "making",
    "outputs",
]
