"""Loop of ``ertis listen`` over SYNC pulses: one line per pulse."""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Protocol, Self, TypeVar

import click

from ertis_cli import options
from ertis_cli._product_printer import ProductTable
from ertis_cli._stop_signals import stopped_by_signals

__all__ = ["Connect", "listen_pulses"]

_POLL_INTERVAL_S = 0.1

Arrival_co = TypeVar("Arrival_co", covariant=True)
Arrival = TypeVar("Arrival")


class _PulseSubscriber(Protocol[Arrival_co]):
    counts: Any

    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...
    @property
    def connected(self) -> bool: ...
    @property
    def n_skipped(self) -> int: ...
    def receive(self, timeout_s: float | None = None) -> Arrival_co | None: ...
    def close(self) -> None: ...


Connect = Callable[[Callable[[str], None]], _PulseSubscriber[Arrival]]
"""Function that gets the receiver of notes, and returns a subscriber."""


def listen_pulses(
    address: str,
    sensors: Sequence[str],
    connect: Connect[Arrival],
    show: Callable[[Arrival], None],
    *,
    head: str,
    of: tuple[str, str] = ("pulse", "images"),
    product: str = "energyscape",
    at_end: Callable[[Any], None] = lambda _: None,
    n: int | None,
    duration: float | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Show each pulse until a signal, a count or a duration ends the command; no sensors means all."""
    # `of` names the shown item in the singular, and dropped ones in the plural; `at_end` is always called.
    notes: deque[str] = deque()
    heard = ProductTable(as_json=as_json, quiet=quiet)
    with stopped_by_signals() as signals, connect(notes.append) as subscriber:
        signals.obey(subscriber.close)
        begun_s, received = time.monotonic(), 0  # Connecting loads kernels, which may take longer than the duration.
        end_s = math.inf if duration is None else begun_s + duration
        if not as_json:
            click.echo(head)
        with ExitStack() as ended:
            ended.callback(lambda: _summarise(subscriber, received, of, quiet=quiet, as_json=as_json))
            ended.callback(at_end, subscriber)
            while received != n and not signals.came and time.monotonic() < end_s:
                arrival = subscriber.receive(_POLL_INTERVAL_S)
                heard.connection(subscriber, address, tuple(sensors), (product,), time.monotonic() - begun_s)
                heard.show_notes(notes)
                if arrival is not None:
                    received += 1
                    show(arrival)
            heard.silent(address, (product,), subscriber.counts.received, at_end=True)
    if signals.came:
        sys.exit(0 if n is None and duration is None else 128 + signals.came[0])
    heard.require_answer(address, time.monotonic() - begun_s)
    if n is not None and received < n:
        raise click.ClickException(f"received {received} of {n} {of[0]}s in {duration:g} s; use a longer --duration")


def _summarise(
    subscriber: _PulseSubscriber[Any], received: int, of: tuple[str, str], *, quiet: bool, as_json: bool
) -> None:
    """Print a summary, also after an error."""
    dropped, skipped = subscriber.counts.dropped, subscriber.n_skipped
    if as_json:
        options.print_json({"event": "listened", "received": received, "dropped": dropped, "skipped": skipped})
    options.say(f"{options.counted(received, of[0])}, {dropped} {of[1]} dropped, {skipped} skipped", quiet=quiet)
