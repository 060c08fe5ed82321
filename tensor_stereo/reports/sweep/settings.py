"""The settings of trials: which tell trials apart, and how they are called and printed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import polars as pl

from tensor_stereo.configs import DETECTORS, ConsensusConfig, SGBMConfig


@dataclass(frozen=True)
class Setting:
    """How a column of settings is called, what null means in it, and whether its words need the heading beside them."""

    heading: str
    none: str = "–"
    needs_heading: bool = False


SETTINGS = {
    "detector": Setting("detector"),
    "feature_backend": Setting("features"),
    "method": Setting("matching"),
    "window_px": Setting("window px"),
    "max_ratio": Setting("max. ratio", "off"),
    "mutual": Setting("mutual"),
    "max_row_offset_px": Setting("row offset px", "off"),
    "min_disparity_px": Setting("min. disparity px", "off"),
    "max_disparity_px": Setting("max. disparity px", "off"),
    **{f"sgbm_{f.name}": Setting(f"SGBM {f.name.replace('_', ' ')}") for f in fields(SGBMConfig)},
    "variant": Setting("variant"),
    "repair": Setting("repair"),
    "refine": Setting("refine"),
    "verdict": Setting("verdict"),
    "min_group_size": Setting("min. group"),
    "tie_tolerance": Setting("tie tolerance"),
    "outlier_rate": Setting("outliers"),
    "noise_px": Setting("noise px"),
    "seed": Setting("seed"),
    "score": Setting("score"),
    "rectified": Setting("rectified", needs_heading=True),
    "temperature": Setting("temperature"),
    "temperature_unit": Setting("unit"),
    **{f"consensus_{f.name}": Setting(f"consensus {f.name.replace('_', ' ')}") for f in fields(ConsensusConfig)},
    "threshold": Setting("threshold"),
    "target_sensitivity": Setting("target sens."),
    "min_precision": Setting("min. precision"),
    "max_error_px": Setting("max. error px"),
}
PERTURBATIONS = ("outlier_rate", "noise_px")
_PARENTS = ("detector", "method", "verdict", "score")  # on which other settings can depend


def telling_settings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the settings that tell some rows apart; the rows may lack some settings.

    One that follows from the detector, the matching, the verdict or the score, as a window that only FAST has, adds
    nothing and is left out.

    >>> row = dict.fromkeys(SETTINGS, 0)
    >>> telling_settings([row, row | {"score": 1, "temperature": 5.0}, row | {"noise_px": 2}])
    ['noise_px', 'score']
    """
    alone = {name: len({row[name] for row in rows}) for name in SETTINGS if rows and name in rows[0]}

    def follows(name: str) -> bool:
        return any(len({(row[parent], row[name]) for row in rows}) == alone[parent] for parent in _PARENTS)

    return [name for name in alone if alone[name] > 1 and (name in _PARENTS or not follows(name))]


def varying_settings(frames: Iterable[pl.DataFrame]) -> list[str]:
    """Names of the settings that tell some rows of all frames together apart."""
    return telling_settings([row for frame in frames for row in frame.select(*SETTINGS).unique().iter_rows(named=True)])


def setting_text(name: str, value: Any) -> str:
    """A setting as the report prints it.

    >>> setting_text("max_ratio", None), setting_text("mutual", True), setting_text("noise_px", 0.50)
    ('off', 'yes', '0.5')
    >>> setting_text("rectified", "false"), setting_text("rectified", "auto")
    ('no', 'auto')
    """
    if value is None:
        return SETTINGS[name].none
    if isinstance(value, bool) or value in ("true", "false"):
        return "yes" if value in (True, "true") else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def settings_label(row: Mapping[str, Any], names: Sequence[str]) -> str:
    """Some settings of a row in a few words.

    Words speak for themselves, numbers come with their heading; settings that do not apply are left out.

    >>> row = dict(verdict="cardinality", score="topology", temperature=0.5, temperature_unit=None, threshold=None)
    >>> settings_label(row, list(row))
    'cardinality, topology, temperature 0.5'
    >>> settings_label({"score": "learned", "rectified": "auto"}, ["score", "rectified"])
    'learned, rectified auto'
    """
    parts = []
    for name in names:
        text = setting_text(name, row[name])
        if name == "verdict" and text == "score":
            parts.append("by score")
        elif name == "score" and text == "none":
            parts.append("no score")
        elif text != Setting.none:
            is_word = isinstance(row[name], str) and not SETTINGS[name].needs_heading
            parts.append(text if is_word else f"{SETTINGS[name].heading} {text}")
    return ", ".join(parts) or "all settings alike"


def order_detectors(names: Iterable[str]) -> list[str]:
    """Detectors in the order of the paper's tables, unknown ones last.

    >>> order_detectors(["orb", "gftt", "sift"])
    ['sift', 'gftt', 'orb']
    """
    known: dict[str, int] = {name: k for k, name in enumerate(DETECTORS)}
    return sorted(names, key=lambda name: (known.get(name, len(known)), name))
