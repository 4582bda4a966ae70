# Public names; __init__.py imports each of them at its first use.

from .campaign import (
    Campaign as Campaign,
    Event as Event,
    RecordingEnded as RecordingEnded,
    RecordingProgress as RecordingProgress,
    RecordingStarted as RecordingStarted,
)
from .map_job import MapJob as MapJob, prepare_maps as prepare_maps
from .recording_job import RecordingJob as RecordingJob, prepare_recording as prepare_recording
from .recordings import RecordingFile as RecordingFile, find_recordings as find_recordings, output_paths as output_paths
from .tasks import CampaignOptions as CampaignOptions
