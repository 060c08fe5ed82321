"""What a sweep of a million pairs costs before its first unit: start, resume and one shard, against an empty sweep.

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

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets.pair_table import SCHEMA, PairTable
from tensor_stereo.evaluation.rows import STAGES
from tensor_stereo.sweeps import expand_grid
from tensor_stereo.sweeps.batches import METRICS_SCHEMA, make_batch
from tensor_stereo.sweeps.store import RunStore

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite

NUM_PAIRS = 1_000_000
ROUNDS = 5
SETTINGS = '[grid]\ndetector = "fast"\nverdict = "cardinality"\nscore = "none"\n'
CONFIG = SweepConfig(expand_grid([{"detector": "fast", "verdict": "cardinality", "score": "none"}]))
_COMMAND = """
import resource, sys, time
start = time.perf_counter()
from tensor_stereo.cli import main
main(sys.argv[1:])
usage = resource.getrusage(resource.RUSAGE_SELF)
print(time.perf_counter() - start, usage.ru_maxrss / 1024, "torch" in sys.modules)
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


def finish(run: Path, manifest: Path) -> None:
    """Enter all units as done, a thousand in each part."""
    row = dict.fromkeys(METRICS_SCHEMA) | {"trial": 0, "num_valid": 1, "seconds": dict.fromkeys(STAGES, 0.1)}
    batch = make_batch([row | {"unit": 0, "dataset": "d", "scene": "s"}] * 1000)
    known = json.loads((run / "config.json").read_text())
    with RunStore(run, known, PairTable(manifest, check_files=False), units_per_part=1000) as store:
        for first in range(0, NUM_PAIRS, 1000):
            units = np.arange(first, first + 1000, dtype=np.int32)
            metrics = batch.metrics.with_columns(unit=pl.Series(units))
            store.add(batch._replace(done=tuple(units.tolist()), metrics=metrics))


def timed(*arguments: str) -> tuple[float, float]:
    """Seconds and MB of one process."""
    command = [sys.executable, "-P", "-c", _COMMAND, "sweep", *arguments]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1].split()
    assert printed[2] == "False", "planning must load no torch"
    return float(printed[0]), float(printed[1])


def main() -> None:
    suite = Suite("million_pairs")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sweep.toml").write_text(SETTINGS)
        manifests = {
            kind: write_manifest(folder / f"{kind}.parquet", n) for kind, n in (("none", 0), ("all", NUM_PAIRS))
        }
        cases = {
            "an empty sweep": ("none", "empty", ()),
            "start": ("all", "begun", ("--limit", "0")),
            "shard 3 of 100": ("all", "shard", ("--limit", "0", "--shard", "3/100")),
            "resume, all units finished": ("all", "finished", ()),
        }
        for kind, run, options in cases.values():  # the first start of each tries the grid out
            paths = ("--manifest", str(manifests[kind]), "--out", str(folder / run))
            timed(str(folder / "sweep.toml"), *paths, *(options or ("--limit", "0")))
        finish(folder / "finished", manifests["all"])
        found: dict[str, list[tuple[float, float]]] = {case: [] for case in cases}
        for _ in range(ROUNDS):
            for case, (kind, run, options) in cases.items():
                paths = ("--manifest", str(manifests[kind]), "--out", str(folder / run))
                found[case].append(timed(str(folder / "sweep.toml"), *paths, *options))
        base = statistics.median(seconds for seconds, _ in found["an empty sweep"])
        base_mb = statistics.median(mb for _, mb in found["an empty sweep"])
        for case, values in found.items():
            seconds, mb = (statistics.median(column) for column in zip(*values, strict=True))
            highest = max(value for value, _ in values)
            suite.note(case, seconds=seconds, highest=highest, mb=mb, more_seconds=seconds - base, more_mb=mb - base_mb)
    suite.write()


if __name__ == "__main__":
    main()
