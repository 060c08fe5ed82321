"""A sweep's settings: TOML tables of lists -> the points of their product. Imports no torch."""

from __future__ import annotations

import itertools
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from tensor_stereo.configs import DETECTORS, ObjectsConfig, SGBMConfig, SweepConfig, TrialConfig
from tensor_stereo.limits import LimitError

_DEFAULT = TrialConfig()
_TOP = ("grid", "export_matches")
_MAX_LISTED = 20  # points in a message
_MAX_BYTES, _MAX_KEY_PARTS, _MAX_POINTS = 1 << 20, 32, 100_000
_KEY_PART = re.compile(r"""\s*[\w"'-]+\s*""")
_RENAMED = {"restriction": "verdict"}


def read_grid(path: Path | str) -> SweepConfig:
    r"""Read the settings of a sweep.

    ``[grid]`` names settings as the command line does (``detector``, ``fast.window_px``, ``matching.max_ratio``, ...);
    each has a value or a list of values, and the sweep goes through their product. Several tables ``[[grid]]`` are the
    union of their products, for settings that belong together. ``"none"`` stands for None. ``export_matches = true``
    above the tables keeps every match with its verdict.

    Args:
        path: TOML file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no TOML, or a setting is unknown or has a wrong value; the message names file and setting.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "sweep.toml")
    ...     _ = path.write_text('[grid]\ndetector = ["fast", "gftt"]\noutlier_rate = [0.0, 0.5]\n')
    ...     [(trial.detector, trial.outlier_rate) for trial in read_grid(path).trials]
    [('fast', 0.0), ('fast', 0.5), ('gftt', 0.0), ('gftt', 0.5)]
    """
    path = Path(path)
    document = _read_document(path)
    try:
        export_matches = document.get("export_matches", False)
        if not isinstance(export_matches, bool):
            raise ValueError(f"export_matches must be true or false, got {export_matches!r}")
        return SweepConfig(expand_grid(_tables(document)), export_matches)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def explain_grid(path: Path | str) -> list[str]:
    r"""What becomes of the points of a file of settings that give no trial of their own, one line each.

    Such points contradict themselves, or differ from another one only in settings that they do not use.

    Args:
        path: As :func:`read_grid` takes it.

    Raises:
        FileNotFoundError, ValueError: As :func:`read_grid`, but not for points that contradict themselves.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "sweep.toml")
    ...     _ = path.write_text('[grid]\nverdict = ["cardinality", "score"]\nthreshold = ["none", 0.3]\n')
    ...     len(explain_grid(path))
    1
    """
    path = Path(path)
    lines = []
    known: dict[TrialConfig, str] = {}
    try:
        tables = _tables(_read_document(path))
        for number, table in enumerate(tables):
            where = f"grid {number + 1}: " if len(tables) > 1 else ""
            for text, trial in _points(list(_axes(table, TrialConfig, ""))):
                point = where + (text or "the only point")
                if isinstance(trial, ValueError):
                    lines.append(f"{point}: an error: {trial}")
                elif (other := known.setdefault(simplify(trial), point)) != point:
                    lines.append(f"{point}: the same as {other}; what tells them apart is not used")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return lines


def _read_document(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of settings {path}")
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path} must have at most {_MAX_BYTES} bytes, got {path.stat().st_size}")
    try:
        text = path.read_text(encoding="utf-8")
        _check_dots(text)
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no TOML file: {error}") from error
    unknown = sorted(document.keys() - set(_TOP))
    if unknown:
        raise ValueError(f"{path}: {unknown[0]!r} is unknown above the tables; known are {', '.join(_TOP)}")
    return document


def _tables(document: Mapping[str, Any]) -> list[Any]:
    tables = document.get("grid", {})
    return tables if isinstance(tables, list) else [tables]


def _check_dots(text: str) -> None:
    """Raise for keys of many parts, each of which costs the parser another table and a copy of the name so far."""
    run = 0
    for part in text.split("."):
        run = run + 1 if _KEY_PART.fullmatch(part) else 0
        if run > _MAX_KEY_PARTS:
            raise ValueError(f"a key must have at most {_MAX_KEY_PARTS} parts")


def expand_grid(tables: Sequence[Mapping[str, Any]]) -> tuple[TrialConfig, ...]:
    """The points of a union of products.

    Settings that a point does not use (other detectors, the seed where nothing is random, the temperature of another
    score than topology, the settings of consensus for another score, those of another matching method) are set to their
    defaults, and equal points are one. Points whose settings contradict each other, such as a threshold under a verdict
    of the paper, are errors that are listed together: such a grid is several tables.

    Args:
        tables: settings as :func:`read_grid` describes them, nested by their dots.

    Returns:
        Distinct points, by detector first, such that those that share a stage follow one another.

    Raises:
        ValueError: if a setting is unknown or has a wrong value; the message names it. If points contradict themselves;
            the message lists them.

    >>> [trial.seed for trial in expand_grid([{"detector": "fast", "seed": [0, 1], "gftt": {"window_px": [7, 11]}}])]
    [0]
    """
    points: dict[TrialConfig, None] = {}
    for number, table in enumerate(tables):
        try:
            axes = list(_axes(table, TrialConfig, ""))
            for trial in _expand(axes):
                points[simplify(trial)] = None
        except ValueError as error:
            where = f"grid {number + 1}: " if len(tables) > 1 else ""
            raise ValueError(f"{where}{error}") from error
    return tuple(sorted(points, key=lambda trial: DETECTORS.index(trial.detector)))


def _expand(axes: Sequence[tuple[tuple[str, ...], list[Any]]]) -> list[TrialConfig]:
    """The points of one product; raises for those that contradict themselves, all at once."""
    trials, wrong = [], []
    for point, trial in _points(axes):
        if isinstance(trial, ValueError):
            wrong.append(f"{point}: {trial}" if point else str(trial))
        else:
            trials.append(trial)
    if wrong:
        shown = "; ".join(wrong[:_MAX_LISTED]) + ("; ..." if len(wrong) > _MAX_LISTED else "")
        num_points = len(trials) + len(wrong)
        head = f"{len(wrong)} of {num_points} points contradict themselves, put them in tables [[grid]] of their own: "
        raise ValueError((head if num_points > 1 else "") + shown)
    return trials


def _points(axes: Sequence[tuple[tuple[str, ...], list[Any]]]) -> Iterator[tuple[str, TrialConfig | ValueError]]:
    """Every point of one product in words, by what varies, with its settings or with why they contradict each other."""
    num_points = math.prod(len(values) for _, values in axes)
    if num_points > _MAX_POINTS:
        raise ValueError(f"a grid must have at most {_MAX_POINTS} points, got {num_points}")
    for values in itertools.product(*(values for _, values in axes)):
        settings: dict[str, Any] = {}
        for (names, _), value in zip(axes, values, strict=True):
            place = settings
            for name in names[:-1]:
                place = place.setdefault(name, {})
            place[names[-1]] = value
        varying = [(names, v) for (names, some), v in zip(axes, values, strict=True) if len(some) > 1]
        point = ", ".join(f"{'.'.join(names)} = {'none' if value is None else value}" for names, value in varying)
        try:
            yield point, _make(_DEFAULT, settings)
        except LimitError:  # no matter of the other settings
            raise
        except ValueError as error:
            yield point, error


def simplify(trial: TrialConfig) -> TrialConfig:
    """The same trial with every setting that it does not use at its default.

    >>> simplify(TrialConfig(seed=3)).seed, simplify(TrialConfig()).score
    (0, 'learned')
    """
    unused: dict[str, Any] = {name: getattr(_DEFAULT, name) for name in DETECTORS if name != trial.detector}
    if not trial.outlier_rate and not trial.noise_px:
        unused["seed"] = _DEFAULT.seed
    unused["score"] = trial.resolved_score
    if trial.resolved_score != "topology":
        unused |= {"temperature": _DEFAULT.temperature, "temperature_unit": _DEFAULT.temperature_unit}
    if trial.resolved_score != "consensus":
        unused["consensus"] = _DEFAULT.consensus
    if not trial.is_probability:
        unused["rectified"] = _DEFAULT.rectified
    if not trial.constrained:
        unused["objects"] = ObjectsConfig()
    if trial.matching.method == "sgbm":
        unused["matching"] = replace(trial.matching, max_row_offset_px=None)
        unused[trial.detector] = _without_descriptors(getattr(trial, trial.detector))
    else:
        unused["sgbm"] = SGBMConfig()
    return replace(trial, **unused)


def _without_descriptors(features: Any) -> Any:
    """Settings of a detector with those of its descriptors at their defaults."""
    default = type(features)()
    own = {name: getattr(default, name) for name in ("window_px", "max_ratio") if hasattr(default, name)}
    return replace(features, **own)


def _axes(table: Any, config: type, prefix: str) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """(path of a setting, its values) of one table."""
    hints = get_type_hints(config)
    if not isinstance(table, Mapping):
        raise ValueError(f"{prefix.rstrip('.') or 'grid'} must be a table of settings, got {table!r}")
    for name, value in table.items():
        if not prefix and name in _RENAMED:
            raise ValueError(f"{name} is {_RENAMED[name]} now")
        if name not in hints:
            raise ValueError(f"{prefix}{name} is no setting; known are {', '.join(f.name for f in fields(config))}")
        if is_dataclass(hints[name]):
            for names, values in _axes(value, hints[name], f"{prefix}{name}."):
                yield (name, *names), values
            continue
        given = value if isinstance(value, list) else [value]
        if not given:
            raise ValueError(f"{prefix}{name} must have at least one value, got []")
        yield (name,), [_convert(f"{prefix}{name}", item, hints[name]) for item in given]


def _convert(name: str, value: Any, hint: Any) -> Any:
    """A value of the type that a setting has."""
    if get_origin(hint) in (Union, UnionType):  # float | None
        if value is None or value == "none":
            return None
        (hint,) = (part for part in get_args(hint) if part is not NoneType)
    if get_origin(hint) is Literal:
        if not any(type(value) is type(one) and value == one for one in get_args(hint)):  # 1 is not True
            raise ValueError(f"{name} must be one of {', '.join(map(str, get_args(hint)))}, got {value!r}")
        return value
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:
        raise ValueError(f"{name} must be {hint.__name__}, got {value!r}")
    if value != value:
        raise ValueError(f"{name} must be a number, got {value!r}")
    if hint is int and abs(value) >= 2**31:
        raise ValueError(f"{name} must lie within 32 bits, got {value}")
    return value


def _make(default: Any, settings: Mapping[str, Any]) -> Any:
    """The default settings with others, nested by name, in their place; made at once, so that checks see them all."""
    values = {
        name: _make(getattr(default, name), value) if isinstance(value, dict) else value
        for name, value in settings.items()
    }
    return replace(default, **values)
