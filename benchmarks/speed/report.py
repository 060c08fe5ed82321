"""Writes results/speed.md from what the suites of this folder wrote.

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


def main() -> None:
    lines = [
        "# Times and memory",
        "",
        "Two x86-64 cores with AVX-512; medians of the rounds of one run, in turns. Ratios are to the first row, with",
        "quartiles; ms are for orientation. Written by `speed/report.py`.",
    ]
    for name, text in SUITES.items():
        lines += ["", f"## {name}", "", text, *tables(read_records(name))]
    (RESULTS / "speed.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
