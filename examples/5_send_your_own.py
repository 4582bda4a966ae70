"""Send measurements from your own program to a central node, and wait until they are on its disk.

::

    ertis record -o recordings &
    python examples/5_send_your_own.py tcp://127.0.0.1:5601 data/synthetic/reflectors.h5
"""

import secrets
import sys
import time

import ertis_numba as ertis


def main(address: str, path: str) -> None:
    """Send the measurements of a recording with the present time."""
    recording, session_id = ertis.open_recording(path), secrets.randbits(63)  # numbers restart in a new session
    with recording, ertis.SensorNode(address, on_note=print) as node:  # spool=DIR keeps measurements through a crash
        node.add_sensor("mine", recording.settings)
        for number, found in enumerate(recording):
            stamp = ertis.Stamp(sensor="mine", session_id=session_id, sequence=number, timestamp_ns=time.time_ns())
            made = ertis.Measurement(found.data, found.settings, stamp)
            node.append([ertis.JournalEntry(made, time.monotonic_ns())])
        if not node.flush(timeout_s=10):
            sys.exit(f"{address} has not acknowledged {node.unacked} measurements; start 'ertis record' there")
        print(f"{node.counts['mine'].stored} stored")


if __name__ == "__main__":
    main(*sys.argv[1:])
