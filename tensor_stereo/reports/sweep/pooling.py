"""From one row per unit and trial to one row per trial: counts added up over the pairs, and means over them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import polars as pl
import torch

from tensor_stereo.configs import DETECTORS, ConsensusConfig, SGBMConfig
from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, Confusion, ScoreCounts
from tensor_stereo.evaluation.rows import SCORE_BINS
from tensor_stereo.reports.sweep.results import COUNTS


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
CELLS = ("true_positive", "false_positive", "true_negative", "false_negative")
TOTALS = ("num_matches", "num_valid", "num_untested", *CELLS)
VERDICT_RATES = ("fraction_incorrect", "sensitivity", "specificity", "ppv", "npv", "precision", "recall")
SCORE_RATES = ("auc", "specificity_at_sensitivity_96")
PERTURBATIONS = ("outlier_rate", "noise_px")
_BALANCED = (pl.col("sensitivity") + pl.col("specificity")) / 2


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


def decided_by_score(row: Mapping[str, Any]) -> bool:
    """Whether the verdict of a row is one of the score.

    >>> decided_by_score({"verdict": "adjacency"}), decided_by_score({"verdict": "score"})
    (False, True)
    """
    return bool(row["verdict"] == "score")


def mildest(results: pl.DataFrame) -> pl.DataFrame:
    """The rows with the fewest added outliers of their detector and, of these, the least noise."""
    for name in PERTURBATIONS:
        results = results.filter(pl.col(name) == pl.col(name).min().over("detector"))
    return results


def pool_trials(results: pl.DataFrame, *, over: Sequence[str] = ()) -> pl.DataFrame:
    """One row per trial.

    Args:
        results: rows of one run.
        over: settings to pool as well, ``("seed",)`` adds the repetitions up; ``trial`` is the first one then.

    Returns:
        ``trial``, ``repeat``, the settings but those of ``over``, ``num_pairs``; the counts ``TOTALS`` and ``COUNTS``
        added up, with the rates that follow from them under their own names; ``mean_`` + name, the mean of each rate
        over the pairs where it is defined; ``seconds``, the mean over the pairs. Undefined rates are NaN, undefined
        means null; AUC and specificity at sensitivity .96 are null without score.
    """
    rates = VERDICT_RATES + SCORE_RATES
    keys = [name for name in SETTINGS if name not in over]
    groups = with_repeat(results).group_by(*keys, "repeat", maintain_order=True)
    bins = {name: [f"{name}_{k}" for k in range(SCORE_BINS)] for name in COUNTS}
    sums = groups.agg(
        pl.col("trial").first(),
        pl.struct("dataset", "scene").n_unique().alias("num_pairs"),
        pl.col(TOTALS).sum(),
        pl.col(rates).fill_nan(None).mean().name.prefix("mean_"),
        total_seconds(results).mean().alias("seconds"),
        pl.col(COUNTS[0]).is_not_null().all().alias("scored"),
        *(pl.col(name).list.get(k).sum().alias(bins[name][k]) for name in COUNTS for k in range(SCORE_BINS)),
    )
    pooled = sums.select(
        pl.exclude("scored", *bins[COUNTS[0]], *bins[COUNTS[1]]),
        *(pl.when("scored").then(pl.concat_list(bins[name])).alias(name) for name in COUNTS),
    )
    found = [_rates(row) for row in pooled.iter_rows(named=True)]
    return pooled.hstack(pl.DataFrame(found, schema=dict.fromkeys(rates, pl.Float64))).sort("trial")


def _rates(row: Mapping[str, Any]) -> dict[str, float | None]:
    """The rates of added-up counts."""
    rates: dict[str, float | None] = asdict(Confusion(*(row[name] for name in CELLS)).rates())
    if row[COUNTS[0]] is None:
        return rates | dict.fromkeys(SCORE_RATES)
    counts = score_counts(row)
    return rates | {"auc": counts.auc(), "specificity_at_sensitivity_96": counts.specificity_at(PAPER_SENSITIVITY)}


def with_repeat(results: pl.DataFrame) -> pl.DataFrame:
    """The same rows with ``repeat``, which numbers the trials that agree in all ``SETTINGS``.

    There are such where a grid varies a setting that has no column, as the threshold of a detector.
    """
    repeat_of = {}
    seen: Counter[tuple[Any, ...]] = Counter()
    for trial, *point in results.select("trial", *SETTINGS).unique().sort("trial").iter_rows():
        repeat_of[trial] = seen[tuple(point)]
        seen[tuple(point)] += 1
    numbers = [repeat_of[trial] for trial in results["trial"]]
    return results.with_columns(pl.Series("repeat", numbers, pl.Int32))


def score_counts(row: Mapping[str, Any]) -> ScoreCounts:
    """The binned scores of a row with a score; a bin stands for its lower end."""
    edges = torch.arange(SCORE_BINS, dtype=torch.float64) / SCORE_BINS
    return ScoreCounts(edges, *(torch.tensor(row[name], dtype=torch.int64) for name in COUNTS))


def total_seconds(results: pl.DataFrame) -> pl.Expr:
    """Wall time of all stages of each row."""
    stages = [pl.col("seconds").struct.field(name) for name in stage_names(results)]
    return pl.sum_horizontal(stages)


def stage_names(results: pl.DataFrame) -> list[str]:
    """The stages that ``seconds`` has."""
    return [field.name for field in results.schema["seconds"].fields]  # type: ignore[attr-defined]


def order_detectors(names: Iterable[str]) -> list[str]:
    """Detectors in the order of the paper's tables, unknown ones last.

    >>> order_detectors(["orb", "gftt", "sift"])
    ['sift', 'gftt', 'orb']
    """
    known: dict[str, int] = {name: k for k, name in enumerate(DETECTORS)}
    return sorted(names, key=lambda name: (known.get(name, len(known)), name))


def stage_times(results: pl.DataFrame) -> pl.DataFrame:
    """Mean ms of each stage over the rows in which it ran, and of all together, per detector.

    Stages that never ran have no column, and null is for a detector that never had it.
    """
    names = [*stage_names(results), "total"]
    spent = [*(pl.col("seconds").struct.field(name) for name in names[:-1]), total_seconds(results).alias("total")]
    times = results.select("detector", *(seconds * 1000 for seconds in spent))
    means = times.group_by("detector").agg(pl.col(name).filter(pl.col(name) > 0).mean() for name in names)
    ran = [name for name in names if means[name].is_not_null().any()]
    return _in_order(means).select("detector", *ran)


def best_trials(results: pl.DataFrame) -> pl.DataFrame:
    """The trial of each detector with the highest mean of sensitivity and specificity.

    Of those with the mildest perturbation, pairs pooled. Columns as of :func:`pool_trials`.
    """
    pooled = pool_trials(mildest(results)).with_columns(balanced_accuracy=_BALANCED)
    known = pooled.filter(pl.col("balanced_accuracy").is_not_nan())
    # of equal ones rather one with a score, which tells more
    best = known.sort("balanced_accuracy", pl.col("auc").is_not_null(), "trial", descending=[True, True, False])
    return _in_order(best.unique("detector", keep="first", maintain_order=True))


def worst_pairs(results: pl.DataFrame, num: int = 3) -> pl.DataFrame:
    """The pairs on which even the best trial does badly.

    Of the rows with the mildest perturbation, each pair and detector keeps the one with the highest mean of
    sensitivity and specificity, the first of equal ones. Rows that lack correct or incorrect matches say nothing and
    are left out.

    Args:
        results: rows of one run.
        num: how many per detector at most.

    Returns:
        The kept rows where that mean is lowest, the lowest first within a detector, with the mean as
        ``balanced_accuracy``.
    """
    pair = ["dataset", "scene", "detector"]
    rows = mildest(results).with_columns(balanced_accuracy=_BALANCED).filter(pl.col("balanced_accuracy").is_not_nan())
    best = rows.sort("balanced_accuracy", "trial", descending=[True, False]).unique(pair, keep="first")
    worst = best.sort("balanced_accuracy", *pair).group_by("detector", maintain_order=True).head(num)
    return _in_order(worst)


def _in_order(rows: pl.DataFrame) -> pl.DataFrame:
    """The same rows by detector, those of one detector as they were."""
    parts = [rows.filter(pl.col("detector") == name) for name in order_detectors(rows["detector"].unique())]
    return pl.concat(parts) if parts else rows
