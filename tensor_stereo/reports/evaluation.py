"""An evaluation as files: summary.json, settings.json, the tables as Markdown, one figure per scene and detector."""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tensor_stereo.configs import EvaluationConfig, describe_settings
from tensor_stereo.evaluation.dataset import PairEvaluation
from tensor_stereo.evaluation.metrics import IsolatedCounts
from tensor_stereo.features import to_gray
from tensor_stereo.objects import trace_objects
from tensor_stereo.reports.figures import draw_classification, write_figure
from tensor_stereo.reports.tables import Table, paper_tables, to_markdown
from tensor_stereo.versions import package_versions


def write_evaluation(
    results: Iterable[PairEvaluation],
    config: EvaluationConfig,
    *,
    source: dict[str, Any],
    out: Path | None = None,
) -> list[Table]:
    """Consume an evaluation and make the paper's tables of it.

    Args:
        results: as :func:`tensor_stereo.evaluation.dataset.evaluate_dataset` yields them.
        config: the settings that they were made with.
        source: what was evaluated, for settings.json.
        out: folder for summary.json, settings.json, tables.md and figures/; None writes nothing.

    Returns:
        Tables 1-4 for the detectors of ``config``, with the verdict of the score beside those of the paper; how the
        score ranks matches; Table 5, run-time by stage, putative matches and isolated ones.

    Raises:
        ValueError: if ``out`` holds the results of other settings.
    """
    settings = {"config": asdict(config), "source": source, "versions": package_versions()}
    if out is not None:
        _claim_folder(out, settings)
    rows: list[dict[str, Any]] = []
    isolated: defaultdict[str, IsolatedCounts] = defaultdict(IsolatedCounts)
    for result in results:
        rows += result.rows()
        isolated[result.detector] += result.isolated()
        if out is not None:
            draw_evaluation(result, config, out / "figures" / f"{_file_name(result.pair.name)}-{result.detector}.png")
    tables = [*paper_tables(rows, restriction=config.restriction), isolated_table(isolated)]
    if out is not None:
        (out / "summary.json").write_text(json.dumps(_without_nan(rows), indent=1) + "\n")
        (out / "tables.md").write_text("\n".join(to_markdown(table) for table in tables))
    return tables


def write_errors(errors: Mapping[str, str], out: Path) -> None:
    """Write the reason why each of some pairs failed, by its name, to errors.json; of no errors there is no file."""
    if not errors:
        (out / "errors.json").unlink(missing_ok=True)
        return
    (out / "errors.json").write_text(json.dumps(dict(errors), indent=1) + "\n")


def draw_evaluation(result: PairEvaluation, config: EvaluationConfig, path: Path) -> None:
    """Draw the verdict of the score, if there is one, and that of the paper, constrained by objects, on one pair."""
    paper = next(t for t in reversed(result.trials) if t.config.verdict == config.restriction)
    pair = result.pair
    contours = [trace_objects(to_gray(image[None])[0], config.objects) for image in (pair.image0, pair.image1)]
    verdicts = {
        describe_settings(trial.config): trial.classification.inlier
        for trial in result.trials
        if trial.config.verdict == "score"
    }
    figure = draw_classification(
        pair.image0,
        pair.image1,
        paper.matches,
        verdicts | {f"{describe_settings(paper.config)}, constrained by objects": paper.classification.inlier},
        paper.graphs.adjacency0,
        paper.graphs.adjacency1,
        correct=paper.correct,
        valid=paper.valid,
        contours0=contours[0],
        contours1=contours[1],
        title=f"{pair.name}, {result.detector.upper()}",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_figure(figure, path)


def isolated_table(isolated: Mapping[str, IsolatedCounts]) -> Table:
    """Matches that alone join two objects, per detector: how far "the same 3D object" goes as evidence by itself."""
    columns = ("detector", "correct", "isolated", "fraction", "incorrect", "isolated", "fraction")
    rows = []
    for detector, counts in isolated.items():
        row: list[Any] = [detector.upper()]
        for total, alone in (
            (counts.num_correct, counts.num_correct_isolated),
            (counts.num_incorrect, counts.num_incorrect_isolated),
        ):
            row += [total, alone, alone / total if total else math.nan]
        rows.append(tuple(row))
    return Table("Matches that alone join two objects, over all scenes", columns, tuple(rows))


def _file_name(scene: str) -> str:
    return re.sub(r"[^\w.-]+", "-", scene)


def _claim_folder(out: Path, settings: dict[str, Any]) -> None:
    path = out / "settings.json"
    text = json.dumps(settings, indent=1) + "\n"
    if path.exists() and path.read_text() != text:
        raise ValueError(f"out: {out} holds the results of other settings ({path.name} differs); name another folder")
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: rates with an empty denominator become null."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
