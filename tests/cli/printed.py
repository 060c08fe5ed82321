"""What a command has printed, by name."""

from __future__ import annotations

import pytest


def printed_values(capsys: pytest.CaptureFixture) -> dict[str, str]:
    """The lines of two words on standard output."""
    return dict(line.split() for line in capsys.readouterr().out.splitlines())
