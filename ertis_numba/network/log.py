"""Log lines for people and programs: one event each, with its fields."""

import json
import logging
import re
import sys
from datetime import UTC, datetime
from typing import Any, Final, Protocol

__all__ = ["EventLog", "Logfmt", "NDJson", "Writable", "logger", "show"]

_ROOT: Final = "ertis.network"
_FIELDS: Final = "ertis_fields"
_BARE: Final = re.compile(r"[^\s\"=\\]+")


class Writable(Protocol):
    """Destination of lines."""

    def write(self, text: str, /) -> object:
        """Write text."""

    def flush(self) -> object:
        """Write buffered text."""


class EventLog:
    """Logger of one part of a node, as in ``logger("central_node").warning("conflict", sensor="front", text="…")``."""

    def __init__(self, name: str) -> None:
        self._logger = logging.getLogger(f"{_ROOT}.{name}")

    def debug(self, event: str, **fields: Any) -> None:
        """Log details for debugging."""
        self._log(logging.DEBUG, event, fields)

    def info(self, event: str, **fields: Any) -> None:
        """Log normal events."""
        self._log(logging.INFO, event, fields)

    def warning(self, event: str, **fields: Any) -> None:
        """Log events that need attention."""
        self._log(logging.WARNING, event, fields)

    def error(self, event: str, **fields: Any) -> None:
        """Log failures."""
        self._log(logging.ERROR, event, fields)

    def _log(self, level: int, event: str, fields: dict[str, Any]) -> None:
        self._logger.log(level, "%s", event, extra={_FIELDS: fields})


def logger(name: str) -> EventLog:
    """Return the logger of a part of a node, such as ``"publisher"``."""
    return EventLog(name)


def show(*, as_json: bool = False, level: str = "INFO", stream: Writable | None = None) -> None:
    """Write events as lines to ``stream``, stderr by default, instead of the earlier stream."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(NDJson() if as_json else Logfmt())
    root = logging.getLogger(_ROOT)
    root.handlers[:] = [handler]
    root.setLevel(level)
    root.propagate = False


class Logfmt(logging.Formatter):
    """Formatter for ``TIME level event key=value …``; values with spaces are quoted."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        time, level, event, fields = _parts(record)
        return " ".join((time, level, _word(event), *(f"{_key(key)}={_word(value)}" for key, value in fields.items())))


class NDJson(logging.Formatter):
    """Formatter for one JSON object per event."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        time, level, event, fields = _parts(record)
        return json.dumps({**fields, "time": time, "level": level, "event": event}, default=str)


def _parts(record: logging.LogRecord) -> tuple[str, str, str, dict[str, Any]]:
    fields = {name: value for name, value in getattr(record, _FIELDS, {}).items() if value is not None}
    if record.exc_info and record.exc_info[1] is not None:
        fields.setdefault("text", f"{type(record.exc_info[1]).__name__}: {record.exc_info[1]}")
    time = datetime.fromtimestamp(record.created, UTC)
    return (
        f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond // 1000:03}Z",
        record.levelname.lower(),
        record.getMessage(),
        fields,
    )


def _key(name: str) -> str:
    return re.sub(r"[\s\"=\\]", "_", name)


def _word(value: object) -> str:
    """Return a value as one word, also if it comes from an untrusted peer."""
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if _BARE.fullmatch(text) and text.isprintable() else json.dumps(text)
