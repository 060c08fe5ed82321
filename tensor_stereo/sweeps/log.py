"""A log file of JSON lines, for as long as a sweep runs."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_STANDARD = logging.makeLogRecord({}).__dict__.keys() | {"message", "asctime"}


class JsonFormatter(logging.Formatter):
    """One JSON object per record: time, level, logger, process, message, and what ``extra`` adds."""

    def format(self, record: logging.LogRecord) -> str:
        values = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "process": record.process,
            "message": record.getMessage(),
        }
        extra = {name: value for name, value in record.__dict__.items() if name not in _STANDARD}
        return json.dumps(values | extra, default=str)


@contextmanager
def log_to_file(path: Path, level: str = "INFO") -> Iterator[None]:
    """Append what the package logs to a file.

    Args:
        path: the file, made if it is not there.
        level: the least that is written.

    Raises:
        ValueError: for an unknown level.
        OSError: if the file cannot be opened.
    """
    if level not in LEVELS:
        raise ValueError(f"log_level must be one of {', '.join(LEVELS)}, got {level!r}")
    logger = logging.getLogger("tensor_stereo")
    before = logger.level
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(JsonFormatter())
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
        handler.close()
