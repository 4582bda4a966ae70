"""Reports of ``ertis ros``: topics, notes and counts."""

from collections import deque
from typing import Any

from ertis_cli import options
from ertis_cli._naming import with_options

__all__ = ["RosReport"]


class RosReport:
    """Lines about the progress of the command."""

    def __init__(self, publisher: Any, notes: deque[str], *, quiet: bool, as_json: bool) -> None:
        self._publisher, self._notes, self._quiet, self._as_json = publisher, notes, quiet, as_json
        self._listed: set[str] = set()
        self._n_passive = 0

    def start(self, source: str, participant: Any) -> None:
        """Report the domain and the interface."""
        text = f"publishing {source} in domain {participant.domain} on interface {participant.interface}"
        options.say(f"{text}; Ctrl-C ends", quiet=self._quiet)
        if self._as_json:
            options.print_json(
                {
                    "event": "publishing",
                    "source": source,
                    "domain": participant.domain,
                    "interface": participant.interface,
                }
            )

    def note(self, text: str) -> None:
        """Report an event of the connection."""
        text = with_options(text)
        options.say(text, quiet=self._quiet)
        if self._as_json:
            options.print_json({"event": "note", "text": text})

    def passive(self, count: int) -> None:
        """Report that measurements of a file without a call are left out."""
        self._n_passive = count
        self.note(
            f"note: {options.counted(count, 'measurement')} without a call left out; 'ertis acoustic' makes maps "
            "of their sound"
        )

    def show_notes(self) -> None:
        """Report the notes of other threads."""
        while self._notes:
            self.note(self._notes.popleft())

    def published(self) -> None:
        """Report new topics."""
        for name, topic in self._publisher.topics.items():
            if name not in self._listed:
                self._listed.add(name)
                options.say(f"  {name}  {topic.message}", quiet=self._quiet)
                if self._as_json:
                    options.print_json({"event": "topic", "topic": name, "message": topic.message})

    def end(self) -> None:
        """Report the counts."""
        self.show_notes()
        dropped, left_out, skipped = self._publisher.dropped, self._publisher.left_out, self._publisher.skipped
        n_published = self._publisher.published
        text = f"{options.counted(n_published, 'measurement')} published"
        text += f", {options.counted(dropped, 'message')} dropped for slow subscribers" if dropped else ""
        text += f", {options.counted(left_out, 'message')} left out by rates or pauses" if left_out else ""
        text += f", {options.counted(skipped, 'pulse')} without odometry, which was too slow" if skipped else ""
        options.say(text, quiet=self._quiet)
        if self._as_json:
            counts = {name: topic.published for name, topic in self._publisher.topics.items()}
            options.print_json(
                {
                    "event": "end",
                    "measurements": n_published,
                    "messages": counts,
                    "dropped": dropped,
                    "left_out": left_out + self._n_passive,
                    "skipped": skipped,
                }
            )
