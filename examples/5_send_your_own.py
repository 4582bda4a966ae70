"""Send measurements of your own program to a central node, which has stored them when the program ends.

::

    ertis record -o recordings &
    python examples/5_send_your_own.py tcp://127.0.0.1:5601 data/synthetic/reflectors.h5
"""

import secrets
import sys
import time

import ertis_numba as ertis


def main(address: str, path: str) -> None:
    """Send the measurements of a recording as if they were made now."""
    recording, session_id = ertis.open_recording(path), secrets.randbits(63)  # a new epoch when numbers begin again
    with recording, ertis.SensorNode(address, on_note=print) as node:  # spool=DIR keeps what a crash would lose
        node.add_sensor("mine", recording.settings)
        for number, found in enumerate(recording):
            stamp = ertis.Stamp(sensor="mine", session_id=session_id, sequence=number, timestamp_ns=time.time_ns())
            made = ertis.Measurement(found.data, found.settings, stamp)
            node.append([ertis.Entry(made, time.monotonic_ns())])
        if not node.flush(timeout_s=10):
            sys.exit(f"{node.unacked} measurements have not reached {address}; start 'ertis record' there")
        print(f"{node.counts['mine'].stored} stored")


if __name__ == "__main__":
    main(*sys.argv[1:])
