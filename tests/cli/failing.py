"""What every command does with bad input."""

from __future__ import annotations

import pytest

from tensor_stereo.cli import main


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str], *words: str) -> None:
    """Assert that a command ends with exit code 2 and one line on standard error that has these words."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    for word in words:
        assert word in error
