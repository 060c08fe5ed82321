"""Writes results/speed.md and results/sweep.md from what the suites of this folder wrote.

python benchmarks/speed/report.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.results import RESULTS, read_records

SUITES = {
    "images": "By `speed/images.py`. StereoSGBM: block 5, P1 200, P2 800, 128 disparities, no post-processing, both"
    " images padded on the left by 128 replicated columns.",
    "classify": "By `speed/classify.py`. Graphs and the paper's verdict, without images.",
    "soft": "By `speed/soft.py`. The score `topology` and its gradient beside the hard verdict.",
    "confidence_speed": "By `speed/confidence.py`. The confidence of a semi-global map beside the making of the map.",
    "busy": "By `speed/busy.py`. The command line in a process of its own, beside two processes that never rest.",
    "memory": "By `speed/memory.py`. Peak memory above what the process held before, images included: a pair of 3892 x"
    " 3108 px for every detector; the eight scenes one after the other.",
}

SWEEPS = {
    "sweep": "By `speed/sweep.py`. FAST + `consensus` on rendered pairs of 400 x 300 px; one thread per worker. Plain"
    " calls: the same units in a loop, without queue and run folder.",
    "million_pairs": "By `speed/million_pairs.py`. Whole processes; memory is the most that the process of the sweep"
    " held. `more_`: than an empty sweep.",
}


def tables(records: list[dict[str, Any]]) -> Iterator[str]:
    """Comparisons as tables, then the single figures."""
    compared = [record for record in records if "case" in record]
    for (title, threads), rows in groupby(compared, key=lambda record: (record["title"], record["threads"])):
        yield f"\n**{title}, {threads} thread{'s' * (threads > 1)}**\n"
        yield "| | ms | CPU ms | units a second | time / first |\n|---|---|---|---|---|"
        for row in rows:
            wall, cpu = (row[key]["median"] / row["units"] for key in ("wall_s", "cpu_s"))
            low, middle, high = (row["ratio_to_first"][key] for key in ("q25", "median", "q75"))
            yield (
                f"| {row['case']} | {1e3 * wall:.3g} | {1e3 * cpu:.3g} | {1 / wall:.3g} "
                f"| {middle:.3g} [{low:.3g}, {high:.3g}] |"
            )
    for record in records:
        if "case" not in record:
            values = ", ".join(f"{key} {value:.3g}" for key, value in record.items() if isinstance(value, int | float))
            yield f"\n{record['title']}: {values}."


def write(name: str, title: str, suites: dict[str, str]) -> None:
    lines = [
        f"# {title}",
        "",
        "Two x86-64 cores with AVX-512; medians of the rounds of one run, in turns. Ratios are to the first row, with",
        "quartiles; ms are for orientation. Written by `speed/report.py`.",
    ]
    for suite, text in suites.items():
        lines += ["", f"## {suite}", "", text, *tables(read_records(suite))]
    (RESULTS / name).write_text("\n".join(lines) + "\n")


def main() -> None:
    write("speed.md", "Times and memory", SUITES)
    write("sweep.md", "Sweeps", SWEEPS)


if __name__ == "__main__":
    main()
