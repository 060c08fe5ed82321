"""Print the tables of the README from the stored results: ``python benchmarks/summary.py``."""

from __future__ import annotations

from shared.results import read_records


def print_comparisons(*suites: str) -> None:
    """One row per peer of every comparison."""
    print("| task | ours, a pair, point or match | peer | time of the peer / ours, median [quartiles] |")
    print("|---|---|---|---|")
    ours: dict = {}
    for record in (r for suite in suites for r in read_records(suite)):
        if "case" not in record:
            continue
        if any(record[key] != ours.get(key) for key in ("title", "threads")):
            ours = record
            continue
        time = ours["wall_s"]["median"] / ours["units"]
        ratio = record["ratio_to_first"]
        spread = f"{ratio['median']:.2f} [{ratio['q25']:.2f}, {ratio['q75']:.2f}]"
        task = f"{ours['title']}, {ours['threads']} thread{'s' * (ours['threads'] > 1)}"
        print(f"| {task} | {_duration(time)} | {record['case']} | {spread} |")


def print_scores() -> None:
    """How the soft score ranks matches beside the hard one."""
    print("| putative matches | AUC hard | AUC soft | specificity at sensitivity .96, hard | soft |")
    print("|---|---|---|---|---|")
    found = {r["title"]: r for r in read_records("soft_ranking") if "auc" in r}
    for title, hard in found.items():
        name, kind = title.rsplit(", ", 1)
        if kind != "hard":
            continue
        soft = found[f"{name}, soft 1"]
        figures = (hard["auc"], soft["auc"], hard["specificity_at_96"], soft["specificity_at_96"])
        print(f"| {name} | {' | '.join(f'{value:.3f}' for value in figures)} |")


def _duration(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds > 2e-5 else f"{1e6 * seconds:.2g} us"


if __name__ == "__main__":
    print_comparisons("classify", "graphs", "matching", "pipeline", "soft", "scores")
    print()
    print_scores()
