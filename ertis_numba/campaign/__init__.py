"""Campaigns: processing of many recordings to energyscapes, on all cores or on a cluster.

Each recording becomes a file of its own, complete or not at all, so that a campaign that was ended at any moment goes
on where it stopped. Workers are processes that know nothing of each other: one that dies takes its recording with it
and no other one.
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
