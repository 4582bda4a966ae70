"""Work for forked processes: everything that runs parallel kernels, and every way by which programs fork."""

import concurrent.futures
import functools
import multiprocessing
import os
import pickle
import sys
from pathlib import Path

import numpy as np

import ertis_numba as ertis
from ertis_numba.settings import Call
from ertis_numba.simulation import Point, Scene

DATA = Path(__file__).parents[1] / "data" / "synthetic"
SETTINGS = ertis.Settings().replace("recording.n_samples", 65_536).replace("processing.range_m", (0.3, 1.5))
AHEAD = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SIGNALS = np.random.default_rng(2).standard_normal((4, 4000)).astype(np.float32)


def measurements():
    draws = np.random.default_rng(1).integers(0, 2**32, (4, 65_536), dtype=np.uint32)
    return [ertis.Measurement(words, SETTINGS, ertis.Stamp(sequence=index)) for index, words in enumerate(draws)]


@functools.cache
def pipeline():
    """A pipeline that the parent has used, with the threads of its batches."""
    made = ertis.Pipeline(SETTINGS)
    made.process_batch(measurements())
    return made


@functools.cache
def camera():
    return ertis.AcousticCamera(SETTINGS)


@functools.cache
def recording():
    return ertis.open_recording(DATA / "reflectors.h5")


def new_pipeline():
    with ertis.Pipeline(SETTINGS) as made:
        return made.process(measurements()[0]).amplitude


def simulated():
    return ertis.render(Scene(points=(Point(range_m=1.0),))).data


def mapped():
    mapper = ertis.Mapper({"sensor": AHEAD})
    mapper.add([pipeline().process(measurements()[0])], AHEAD)
    return mapper.map.log_odds


def fused():
    fuser = ertis.Fuser({"a": AHEAD, "b": ((0.1, 0.0, 0.0), AHEAD[1])})
    words = [each.data for each in measurements()]
    return fuser(
        pipeline().process(ertis.Measurement(words[index], SETTINGS, ertis.Stamp(sensor=name)))
        for index, name in enumerate("ab")
    ).image.amplitude


JOBS = {
    "pipeline of the parent": lambda: pipeline().process(measurements()[0]).amplitude,
    "batches": lambda: np.stack([image.amplitude for image in pipeline().process_batch(measurements())]),
    "many": lambda: np.stack([image.amplitude for image in pipeline().process_many(measurements())]),
    "signals": lambda: pipeline().signals(measurements()[0]).matched,
    "new pipeline": new_pipeline,
    "camera of the parent": lambda: camera().process(measurements()[0]).power,
    "new camera": lambda: ertis.AcousticCamera(SETTINGS).process(measurements()[0]).power,
    "demodulate": lambda: ertis.demodulate(
        measurements()[0].data, sample_rate_hz=4.5e6, decimation=10, channels=[0, 1]
    ),
    "matched_filter": lambda: ertis.matched_filter(SIGNALS, sample_rate_hz=450e3, call=Call()),
    "beamform": lambda: ertis.beamform(
        SIGNALS,
        positions_m=[[0, y, 0] for y in (-6e-3, -2e-3, 2e-3, 6e-3)],
        directions_rad=np.radians([[-30, 0], [0, 0], [30, 0]]),
        sample_rate_hz=450e3,
        ranges_m=np.arange(0.3, 0.5, 0.001),
    ),
    "recording of the parent": lambda: recording()[0].data,
    "simulate": simulated,
    "map": mapped,
    "fuse": fused,
}


def work(name):
    return JOBS[name]()


class Loader:
    """Stand-in for a data loader: forked workers get indices from a queue and return items by another one."""

    def __init__(self, dataset, n_workers, context="fork"):
        self._dataset, self._n_workers = dataset, n_workers
        self._context = multiprocessing.get_context(context)

    def __iter__(self):
        indices, results = self._context.SimpleQueue(), self._context.SimpleQueue()
        workers = [
            self._context.Process(target=_serve, args=(self._dataset, indices, results), daemon=True)
            for _ in range(self._n_workers)
        ]
        for worker in workers:
            worker.start()
        for index in range(len(self._dataset)):
            indices.put(index)
        found = dict(results.get() for _ in range(len(self._dataset)))
        for _ in workers:
            indices.put(None)
        for worker in workers:
            worker.join()
        return (found[index] for index in sorted(found))


def _serve(dataset, indices, results):
    while (index := indices.get()) is not None:
        results.put((index, dataset[index]))


class Dataset:
    """Images of a recording that was opened by the parent."""

    def __len__(self):
        return len(JOBS)

    def __getitem__(self, index):
        return work(list(JOBS)[index])


def by_pool(names):
    with multiprocessing.get_context("fork").Pool(2) as pool:
        return pool.map(work, names)


def by_executor(names):
    context = multiprocessing.get_context("fork")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as executor:
        return list(executor.map(work, names))


def by_os_fork(names):
    """Fork directly, one process after the other; a grandchild does each second job."""
    jobs = [functools.partial(work, name) for name in names]
    return [_forked(functools.partial(_forked, job) if index % 2 else job) for index, job in enumerate(jobs)]


def _forked(job):
    ours, theirs = os.pipe()
    process_id = os.fork()
    if not process_id:
        os.close(ours)
        with os.fdopen(theirs, "wb") as file:
            pickle.dump(job(), file)
        os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as file:
        found = pickle.load(file)
    assert os.waitpid(process_id, 0)[1] == 0
    return found


WAYS = {
    "Pool": by_pool,
    "ProcessPoolExecutor": by_executor,
    "os.fork": by_os_fork,
    "data loader": lambda names: list(Loader(Dataset(), 2)),  # noqa: ARG005
}


def main():
    """Do every job here, then in forked processes of each kind, and compare."""
    names = list(JOBS)
    wanted = [work(name) for name in names]
    for way in sys.argv[1:]:
        for name, one, other in zip(names, wanted, WAYS[way](names), strict=True):
            assert np.array_equal(one, other), f"{name} differs in a process forked by {way}"
        sys.stdout.write(f"{way}: {len(names)} equal\n")


if __name__ == "__main__":
    main()
