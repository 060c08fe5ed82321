"""What a sweep of a million pairs costs before its first unit, against an empty sweep; and its report at four points.

    python benchmarks/speed/million_pairs.py

The manifest names few files, many times. Whole processes, as a user starts them; memory is the most that the process
of the sweep held, without its helpers.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from tensor_stereo.datasets.pair_table import SCHEMA, PairTable
from tensor_stereo.evaluation.rows import SCORE_BINS, STAGES
from tensor_stereo.sweeps.batches import METRICS_SCHEMA, BatchResult, make_batch
from tensor_stereo.sweeps.store import RunStore

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite

NUM_PAIRS = 1_000_000
ROUNDS = 5
REPORT_ROUNDS = 3
PART = 1000  # units
RATES = (0.0, 0.2, 0.4, 0.6)  # of outliers, in the run that is reported
SETTINGS = '[grid]\ndetector = "fast"\nverdict = "cardinality"\nscore = "none"\n'
POINTS = '[grid]\ndetector = "fast"\nverdict = "score"\nscore = "learned"\noutlier_rate = [0.0, 0.2, 0.4, 0.6]\n'
_COMMAND = """
import re, sys, time
start = time.perf_counter()
from tensor_stereo.cli import main
main(sys.argv[1:])
seconds, status = time.perf_counter() - start, open("/proc/self/status").read()
print(seconds, int(re.search(r"VmHWM:\\s*(\\d+)", status)[1]) / 1024, "torch" in sys.modules)
"""


def write_manifest(path: Path, count: int) -> Path:
    """``count`` pairs of a sequence, as a reader of drives would list them."""
    number = pl.int_range(count, eager=True).to_frame("k").select(
        drive=pl.col("k") // 1000, frame=(pl.col("k") % 1000).cast(pl.String).str.zfill(10)
    )  # fmt: skip
    folder = "/data/kitti/raw/2011_09_26/drive_{}"
    rows = number.select(
        dataset=pl.lit("kitti-raw"),
        scene=pl.format("drive_{}/{}", "drive", "frame"),
        image0=pl.format(folder + "/image_02/data/{}.png", "drive", "frame"),
        image1=pl.format(folder + "/image_03/data/{}.png", "drive", "frame"),
        disparity_gt=pl.format(folder + "/disparity/{}.png", "drive", "frame"),
        gt_scale=pl.lit(256.0),
        gt_encoding=pl.lit("scaled"),
        width_px=pl.lit(1242),
        height_px=pl.lit(375),
    )
    missing = [pl.lit(None).alias(name) for name in SCHEMA if name not in rows.columns]
    rows.with_columns(missing).select(pl.col(name).cast(dtype) for name, dtype in SCHEMA.items()).write_parquet(path)
    return path


def plain_rows() -> pl.DataFrame:
    """Rows of one part, all alike."""
    row = dict.fromkeys(METRICS_SCHEMA) | {"trial": 0, "num_valid": 1, "seconds": dict.fromkeys(STAGES, 0.1)}
    return make_batch([row | {"unit": k} for k in range(PART)]).metrics


def drawn_rows() -> pl.DataFrame:
    """Rows of one part, of every point, with verdicts and scores of some hundred matches each."""
    rng = np.random.default_rng(0)
    rows = []
    for unit, trial in np.ndindex(PART, len(RATES)):
        correct, incorrect = rng.poisson(2, SCORE_BINS), rng.poisson(1 + 2 * RATES[trial], SCORE_BINS)
        tp, fp = (int(counts[: SCORE_BINS // 2].sum()) for counts in (incorrect, correct))
        fn, tn = int(incorrect.sum()) - tp, int(correct.sum()) - fp
        rows.append(
            dict.fromkeys(METRICS_SCHEMA)
            | {"unit": unit, "trial": trial, "num_matches": tp + fp + tn + fn, "num_valid": tp + fp + tn + fn}
            | {"num_untested": 0, "true_positive": tp, "false_positive": fp, "true_negative": tn, "false_negative": fn}
            | {"sensitivity": tp / (tp + fn), "specificity": tn / (tn + fp), "auc": rng.random()}
            | dict.fromkeys(("fraction_incorrect", "ppv", "npv", "precision", "recall"), rng.random())
            | {"specificity_at_sensitivity_96": rng.random(), "domain": "", "is_rectified": True, "host": "node"}
            | {"score_counts_correct": correct.tolist(), "score_counts_incorrect": incorrect.tolist()}
            | {"seconds": dict(zip(STAGES, rng.exponential(0.1, len(STAGES)).tolist(), strict=True))}
        )
    return make_batch(rows).metrics


def finish(run: Path, manifest: Path, rows: pl.DataFrame) -> None:
    """Enter all units as done, in parts of these rows."""
    table = PairTable(manifest, check_files=False)
    known = json.loads((run / "config.json").read_text())
    names, place = table.rows().select("dataset", "scene").collect(), rows["unit"].to_numpy()
    with RunStore(run, known, table, units_per_part=PART) as store:
        for first in range(0, NUM_PAIRS, PART):
            unit = pl.Series("unit", first + place, dtype=pl.Int32)
            metrics = rows.with_columns(unit, *names[first + place].get_columns())
            store.add(BatchResult(tuple(range(first, first + PART)), (), metrics))


def timed(*arguments: str, torch: bool = False) -> tuple[float, float]:
    """Seconds and MB of one process."""
    command = [sys.executable, "-P", "-c", _COMMAND, *arguments]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1].split()
    assert printed[2] == str(torch), "planning must load no torch"
    return float(printed[0]), float(printed[1])


def main() -> None:
    suite = Suite("million_pairs")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sweep.toml").write_text(SETTINGS)
        (folder / "points.toml").write_text(POINTS)
        none, every = (str(write_manifest(folder / f"{n}.parquet", n)) for n in (0, NUM_PAIRS))

        def sweep(settings: str, manifest: str, run: str, *options: str) -> tuple[str, ...]:
            return "sweep", str(folder / settings), "--manifest", manifest, "--out", str(folder / run), *options

        cases = {
            "an empty sweep": sweep("sweep.toml", none, "empty", "--limit", "0"),
            "start": sweep("sweep.toml", every, "begun", "--limit", "0"),
            "shard 3 of 100": sweep("sweep.toml", every, "shard", "--limit", "0", "--shard", "3/100"),
            "resume, all units finished": sweep("sweep.toml", every, "finished"),
        }
        for run in ("empty", "begun", "shard", "finished", "reported"):  # the first start of each tries the grid out
            settings = "points.toml" if run == "reported" else "sweep.toml"
            timed(*sweep(settings, none if run == "empty" else every, run, "--limit", "0"))
        finish(folder / "finished", Path(every), plain_rows())
        finish(folder / "reported", Path(every), drawn_rows())
        found: dict[str, list[tuple[float, float]]] = {case: [] for case in cases}
        for _ in range(ROUNDS):
            for case, command in cases.items():
                found[case].append(timed(*command))
        base, base_mb = (statistics.median(column) for column in zip(*found["an empty sweep"], strict=True))
        for case, values in found.items():
            seconds, mb = (statistics.median(column) for column in zip(*values, strict=True))
            highest = max(value for value, _ in values)
            suite.note(case, seconds=seconds, highest=highest, mb=mb, more_seconds=seconds - base, more_mb=mb - base_mb)
        reports = [timed("report", str(folder / "reported"), torch=True) for _ in range(REPORT_ROUNDS)]
        seconds, mb = (statistics.median(column) for column in zip(*reports, strict=True))
        sizes = {path.suffix: path.stat().st_size / 1e6 for path in (folder / "reported").glob("report.*")}
        highest = max(value for value, _ in reports)
        suite.note("report of four points", seconds=seconds, highest=highest, mb=mb, page_mb=sizes[".html"])
        of_run = folder / "reported"
        parts, journals = ([*of_run.glob(pattern)] for pattern in ("metrics/part-*.parquet", "journal-*.jsonl"))
        suite.note(
            "on disk, a million pairs at four points",
            manifest_mb=Path(every).stat().st_size / 1e6,
            journal_mb=sum(path.stat().st_size for path in journals) / 1e6,
            metrics_mb=sum(path.stat().st_size for path in parts) / 1e6,
            parts=len(parts),
        )
    suite.write()


if __name__ == "__main__":
    main()
