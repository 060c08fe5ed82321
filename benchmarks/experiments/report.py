"""Writes results/training.md and its figure from what the experiments of this folder wrote.

python benchmarks/experiments/report.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.figures import plt, save_figure
from shared.results import RESULTS, read_records

NO_HINTS = "no guidance"
GROUPS = {"eight": "the eight scenes, bad-2px", "kitti": "KITTI, drive 0015, bad-3px"}
ABOUT = """# What filtered matches are worth in learning-based stereo

Five networks of 392 000 weights, from five seeds (`experiments/train_guided.py`); figures are their means over the
scenes, +- the standard deviation over the networks. *Power*: mean over spread of the difference between no filter and
the oracle; the experiment tells filters apart where it is above 3. *Closed*: part of the gap between the left-right
check and the oracle. Written by `experiments/report.py`.
"""


def percent(row: dict[str, Any]) -> str:
    return f"{100 * row['bad']:.1f} +- {100 * row['bad_spread']:.1f}"


def guided_tables(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield "\n## Guided stereo: matches as hints\n\nBy `experiments/guided_stereo.py`, after Poggi et al., CVPR 2019.\n"
    rows = [row for row in records if "condition" in row]
    for putatives in dict.fromkeys(row["putatives"] for row in rows):
        for group, heading in GROUPS.items():
            of = {r["condition"]: r for r in rows if (r["putatives"], r["group"]) == (putatives, group)}
            yield f"\n**{putatives}; {heading}**\n"
            yield "| hints | number | correct | bad, % | mean error, px | bad at equal numbers, % |"
            yield "|---|---|---|---|---|---|"
            for name, row in of.items():
                if name.endswith(("equal", "wrong")):
                    continue
                equal = of.get(f"{name}, equal")
                correct = "" if not row["hints"] else f"{row['correct']:.0%}"
                yield (
                    f"| {name} | {row['hints']:.0f} | {correct} | {percent(row)} | {row['epe_px']:.2f} "
                    f"| {'' if equal is None else percent(equal)} |"
                )
            curve = ", ".join(f"{name}: {100 * row['bad']:.1f} %" for name, row in of.items() if name.endswith("wrong"))
            yield f"\nCorrect hints with some wrong ones among them: {curve}."
    yield from notes(records)


def adaptation_tables(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield "\n## Adaptation: pixels of a semi-global map as labels\n"
    yield "By `experiments/adaptation.py`, after Tonioni et al., ICCV 2017.\n"
    rows = [row for row in records if "condition" in row]
    for group, heading in GROUPS.items():
        yield f"\n**{heading}**\n\n| labels | share of the pixels | correct | bad, % | mean error, px |"
        yield "|---|---|---|---|---|"
        for row in rows:
            if row["group"] == group:
                share, correct = (f"{row[key]:.0%}" if key in row else "" for key in ("share", "correct"))
                yield f"| {row['condition']} | {share} | {correct} | {percent(row)} | {row['epe_px']:.2f} |"
    yield from notes(records)


def gradient_tables(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield "\n## Gradient: keypoints moved by a score\n"
    yield "By `experiments/score_gradient.py`. Gain: against the windows alone. Five draws of the noise.\n"
    rows = [row for row in records if row.get("set") == "eight"]
    for noise in dict.fromkeys(row["noise_px"] for row in rows):
        yield f"\n**Noise of {noise} px**\n"
        yield "| windows + weight x (1 - score) | error px | median | gain px | beyond 1 px |"
        yield "|---|---|---|---|---|"
        for row in rows:
            if row["noise_px"] == noise:
                what = " + ".join(
                    [
                        *(["windows"] if row["windows"] else []),
                        *([f"{row['score']:g} {row['name']}"] if row["name"] else []),
                    ]
                )
                yield (
                    f"| {what} | {row['before_px']:.3f} -> {row['after_px']:.3f} | {row['median_after_px']:.3f} "
                    f"| {row['gain_px']:+.4f} +- {row['gain_spread_px']:.4f} "
                    f"| {row['bad_before']:.1%} -> {row['bad_after']:.1%} |"
                )


def notes(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    """What part of a gap is closed, and whether the experiment can tell."""
    for row in records:
        if "power" in row:
            closed = ", ".join(f"{name} {v:.2f}" for name, v in row.items() if name not in ("title", "power"))
            yield f"\n{row['title']}: power {row['power']:.1f}; closed: {closed}."


def draw(records: Sequence[dict[str, Any]]) -> None:
    """What each condition changes against no hints, by network, and bad pixels over the share of wrong hints."""
    rows = [row for row in records if "condition" in row]
    kinds = list(dict.fromkeys((row["putatives"], row["group"]) for row in rows))
    figure, axes = plt.subplots(2, len(kinds), figsize=(15, 7), layout="constrained", squeeze=False)
    for k, ((top, bottom), kind) in enumerate(zip(axes.T, kinds, strict=True)):
        of = {r["condition"]: r for r in rows if (r["putatives"], r["group"]) == kind}
        without = np.array(of.pop(NO_HINTS)["networks_bad"])
        plain = {name: row for name, row in of.items() if not name.endswith(("equal", "wrong"))}
        change = 100 * (np.array([row["networks_bad"] for row in plain.values()]) - without)
        colors = ["tab:orange" if name.startswith("learned") else "tab:blue" for name in plain]
        names = list(plain) if k == 0 else [""] * len(plain)
        top.barh(range(len(plain)), change.mean(1), xerr=change.std(1, ddof=1), color=colors)
        top.set_yticks(range(len(plain)), names)
        top.axvline(0, color="black", linewidth=0.8)
        top.invert_yaxis()
        top.set(title=f"{kind[0]}\n{GROUPS[kind[1]]}", xlabel="bad pixels against no hints, %")
        curve = [(float(name.split("%")[0]), 100 * row["bad"]) for name, row in of.items() if name.endswith("wrong")]
        bottom.plot(*zip(*curve, strict=True), marker="o")
        bottom.axhline(100 * without.mean(), color="gray", linestyle="dashed")
        bottom.annotate("no hints", (40, 100 * without.mean()), color="gray", va="top", ha="right")
        bottom.set(xlabel="wrong hints, %", ylabel="bad pixels, %" if k == 0 else "")
    save_figure(figure, "guided_stereo", 75)


def main() -> None:
    lines = [ABOUT]
    guided = read_records("guided_stereo")
    if guided:
        draw(guided)
        lines += guided_tables(guided)
        lines.append("\n![bad pixels by condition and by the share of wrong hints](guided_stereo.png)")
    for name, tables in (("adaptation", adaptation_tables), ("score_gradient", gradient_tables)):
        records = read_records(name)
        lines += tables(records) if records else []
    (RESULTS / "training.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
