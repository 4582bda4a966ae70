"""Detection of sensors that several nodes send because of a wrong name."""

from collections.abc import Callable, Mapping

from ertis_numba.network.central_node._streams import PeerConnection, SensorTrack

__all__ = ["Sharing"]


class Sharing:
    """Detector of sensors that several nodes send; reports each once.

    Parameters
    ----------
    notify : callable
        Called with the name of an event and its fields.
    """

    def __init__(self, notify: Callable[..., None]) -> None:
        self._emit_event = notify
        self._sensors: set[str] = set()

    @staticmethod
    def joins(track: SensorTrack, peer_id: bytes, now_s: float) -> None:
        """Register that a node sends a sensor."""
        if track.peers - {peer_id} and peer_id not in track.peers:
            track.shared_s = now_s
        track.peers.add(peer_id)

    def leaves(self, track: SensorTrack, sensor: str, peer_id: bytes) -> None:
        """Register that a node no longer sends a sensor."""
        track.peers.discard(peer_id)
        if len(track.peers) < 2:
            self._sensors.discard(sensor)

    def tick(self, tracks: Mapping[str, SensorTrack], peers: Mapping[bytes, PeerConnection]) -> None:
        """Report new ones."""
        for sensor, track in tracks.items():
            # A reconnected node may be noticed as gone only seconds later.
            if track.shared_s and all(peers[each].heard_s > track.shared_s for each in track.peers):
                track.shared_s = 0.0
                if len(track.peers) > 1:
                    self._sensors.add(sensor)
                    self._emit_event(
                        "shared", sensor=sensor, text="several sensor nodes send it; give each its own name"
                    )

    def remark(self, peer: PeerConnection | None) -> str:
        """Return a remark for a node, one line; empty if there is none."""
        shared = () if peer is None else sorted(self._sensors & {run.sensor for run in peer.streams})
        if not shared:
            return ""
        return f"another sensor node sends sensor {shared[0]}, too; give each its own name (--name), or end one"
