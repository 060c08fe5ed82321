"""How a command ends: exit codes, and one line on standard error that says why."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def fail(message: str, code: int = FAILED) -> int:
    """Print why a command fails, and return its exit code."""
    print(f"tensor-stereo: {message}", file=sys.stderr)
    return code


def most_frequent(reasons: Iterable[str], num: int = 3) -> str:
    """The most frequent of some reasons, with how often they occur.

    >>> most_frequent(["no such file", "torn", "torn"])
    'torn (2 times); no such file'
    """
    counts = Counter(reasons).most_common()
    shown = [f"{reason} ({count} times)" if count > 1 else reason for reason, count in counts[:num]]
    return "; ".join(shown) + (f"; and {len(counts) - num} other reasons" if len(counts) > num else "")
