"""Small recordings, and a worker pool in this process, for the tests of campaigns."""

import json
from collections import deque

from ertis_numba.campaign import Campaign, RecordingEnded, find_recordings
from ertis_numba.campaign.task_actions import run_task
from ertis_numba.campaign.tasks import TaskUpdate
from ertis_numba.settings import Air
from ertis_numba.storage import write_recording
from tests.files import SMALL, noise

NAMES = ("a", "b", "c", "d")


def write_recordings(folder, names=NAMES, count=3, settings=SMALL, **more):
    """Write recordings with different samples, in air of two temperatures."""
    folder.mkdir(exist_ok=True)
    found = []
    for number, name in enumerate(names):
        at_this_air = settings.replace(air=Air(temperature_c=20.0 + number % 2))
        found.append(write_recording(folder / f"{name}.h5", noise(at_this_air, count=count, seed=number), **more))
    return found


class InlinePool:
    """Worker pool that runs tasks in this process when its events are read."""

    def __init__(self, size=2):
        self.size, self.tasks, self.given, self.largest = size, deque(), [], 0

    @property
    def free(self):
        return max(0, self.size - len(self.tasks))

    def limit(self, size):
        self.size = min(self.size, size)

    def submit(self, task):
        self.tasks.append(task)
        self.given.append(task)

    def wait(self, _):
        task = self.tasks.popleft()
        advanced = []
        arguments = json.loads(json.dumps(task.arguments))  # as for a worker process
        result = run_task(task.action, arguments, lambda done: advanced.append(TaskUpdate(task.number, done)))
        return [*advanced, TaskUpdate(task.number, result=json.loads(json.dumps(result)))]

    def close(self):
        self.tasks.clear()


def run_here(monkeypatch, paths, folder, wanted=None, size=2):
    """Run a campaign in this process; return the last event of each recording by file name, and the pool."""
    pool = InlinePool(size)
    with monkeypatch.context() as patch:
        patch.setattr(Campaign, "_pool", lambda _: pool)
        return ended(Campaign(find_recordings(paths), folder, wanted).run()), pool


def ended(events):
    """Collect the last event of each recording by file name."""
    return {event.recording.name: event for event in events if isinstance(event, RecordingEnded)}


def outcomes(found):
    """Reduce events to their outcomes."""
    return {name: event.outcome for name, event in found.items()}


def names_in(folder):
    """List the names of all files in a folder, sorted."""
    return sorted(item.name for item in folder.iterdir())
