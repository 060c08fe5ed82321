"""A sweep's settings: TOML tables of lists -> the points of their product. Imports no torch."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tensor_stereo.configs import DETECTORS, ObjectsConfig, SweepConfig, TrialConfig

_DEFAULT = TrialConfig()
_TOP = ("grid", "export_matches")


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
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of settings {path}")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML file: {error}") from error
    try:
        unknown = sorted(document.keys() - set(_TOP))
        if unknown:
            raise ValueError(f"{unknown[0]!r} is unknown above the tables; known are {', '.join(_TOP)}")
        tables = document.get("grid", {})
        export_matches = document.get("export_matches", False)
        if not isinstance(export_matches, bool):
            raise ValueError(f"export_matches must be true or false, got {export_matches!r}")
        return SweepConfig(expand_grid(tables if isinstance(tables, list) else [tables]), export_matches)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def expand_grid(tables: Sequence[Mapping[str, Any]]) -> tuple[TrialConfig, ...]:
    """The points of a union of products.

    Settings that a point does not use (other detectors, the seed where nothing is random, the temperature of another
    score than topology, the restriction where the score decides) are set to their defaults, and equal points are one.

    Args:
        tables: settings as :func:`read_grid` describes them, nested by their dots.

    Returns:
        Distinct points, by detector first, such that those that share a stage follow one another.

    Raises:
        ValueError: if a setting is unknown or has a wrong value; the message names it.

    >>> expand_grid([{"detector": "fast", "seed": [0, 1], "gftt": {"window_px": [7, 11]}}]) == (TrialConfig(),)
    True
    """
    points: dict[TrialConfig, None] = {}
    for number, table in enumerate(tables):
        try:
            axes = list(_axes(table, TrialConfig, ""))
            for values in itertools.product(*(values for _, values in axes)):
                trial = _DEFAULT
                for (names, _), value in zip(axes, values, strict=True):
                    trial = _assign(trial, names, value)
                points[simplify(trial)] = None
        except ValueError as error:
            where = f"grid {number + 1}: " if len(tables) > 1 else ""
            raise ValueError(f"{where}{error}") from error
    return tuple(sorted(points, key=lambda trial: DETECTORS.index(trial.detector)))


def simplify(trial: TrialConfig) -> TrialConfig:
    """The same trial with every setting that it does not use at its default.

    >>> simplify(TrialConfig(seed=3)).seed
    0
    """
    unused: dict[str, Any] = {name: getattr(_DEFAULT, name) for name in DETECTORS if name != trial.detector}
    if not trial.outlier_rate and not trial.noise_px:
        unused["seed"] = _DEFAULT.seed
    if trial.score != "topology":
        unused |= {"temperature": _DEFAULT.temperature, "temperature_unit": _DEFAULT.temperature_unit}
    if trial.by_score:
        unused["restriction"] = _DEFAULT.restriction
    if not trial.constrained:
        unused["objects"] = ObjectsConfig()
    return replace(trial, **unused)


def _axes(table: Any, config: type, prefix: str) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """(path of a setting, its values) of one table."""
    hints = get_type_hints(config)
    if not isinstance(table, Mapping):
        raise ValueError(f"{prefix.rstrip('.') or 'grid'} must be a table of settings, got {table!r}")
    for name, value in table.items():
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
    if get_origin(hint) is UnionType:  # float | None
        if value is None or value == "none":
            return None
        (hint,) = (part for part in get_args(hint) if part is not NoneType)
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
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


def _assign(config: Any, names: tuple[str, ...], value: Any) -> Any:
    """The same settings with another value at a path of names."""
    name, *rest = names
    if rest:
        value = _assign(getattr(config, name), tuple(rest), value)
    return replace(config, **{name: value})
