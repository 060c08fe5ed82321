"""Errors of the library in the words of the command line. Imports no torch."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, get_type_hints

from tensor_stereo import configs
from tensor_stereo.cli import commands

_FILES = {"source": "MATCHES", "left": "LEFT", "right": "RIGHT", "disparity": "DISPARITY", "root": "ROOT"}
_FILES |= {"roots": "ROOTS", "runs": "RUNS"}
_FILES |= {"settings": "SETTINGS", "releases": "RELEASES", "matches": "MATCHES"}


def name_flags(message: str) -> str:
    """The message with flags in the place of Python's arguments.

    >>> name_flags("FASTConfig.window_px must be odd and lie in [1, 255], got 10")
    '--fast.window-px must be odd and lie in [1, 255], got 10'
    >>> name_flags("min_precision needs the verdict 'score', got 'cardinality' with 0.9")
    "--min-precision needs --verdict score, got 'cardinality' with 0.9"
    """
    toml = re.match(r"\S+\.toml: ", message)
    for kind, prefix in _sections().items():
        if toml:  # settings of a sweep are keys
            message = re.sub(rf"\b{kind}\.(?=\w)", f"{prefix}.", message)
            continue
        message = re.sub(rf"\b{kind}\.(\w+)", lambda found, prefix=prefix: _flag(f"{prefix}.{found[1]}"), message)  # type: ignore[misc]
    if toml:
        return message
    names = "|".join(sorted(_arguments(), key=len, reverse=True))
    message = re.sub(rf"^({names})(?=:| must\b| needs\b)", lambda found: _flag(found[1]), message)
    message = re.sub(rf"(?<=; )({names})(?= needs)", lambda found: _flag(found[1]), message)
    message = re.sub(r"(?<= as )(source)(?= does)", lambda found: _flag(found[1]), message)
    message = re.sub(r"(another (?:file|folder) than )(\w+)", lambda found: found[1] + _flag(found[2]), message)
    message = re.sub(rf"(?<=must be None beside )({names})\b", lambda found: _flag(found[1]), message)
    message = message.replace("the verdict 'score'", "--verdict score")
    return message.replace("set rectified=False, or 'auto'", "say --rectified False, or auto")


def _flag(name: str) -> str:
    return _FILES.get(name, f"--{name.replace('_', '-')}")


@cache
def _sections() -> dict[str, str]:
    """Prefix of the flags of each nested settings object."""
    hints = get_type_hints(configs.EvaluationConfig)
    return {kind.__name__: name for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}


@cache
def _arguments() -> frozenset[str]:
    """Names of arguments of the library that are flags or files of the command line."""
    kinds: list[Any] = [value for value in vars(commands).values() if is_dataclass(value)]
    found = {field.name for kind in kinds for field in fields(kind)}
    return frozenset(found | {"source"} - {"config"})
