"""What the filter is worth where a disparity network learns from matches alone, and in sub-pixel refinement.

It takes a quarter of an hour; ``--quick`` is a small version on rendered pairs. Nothing that it trains is shipped.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

import tensor_stereo as ts
from tensor_stereo.datasets import SyntheticDataset

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from experiments.disparity_network import TrainedNet, TrainingConfig, train
from experiments.pseudo_labels import CONDITIONS, PseudoLabels, make_pseudo_labels
from experiments.subpixel_refinement import RefinementConfig, refine_pairs
from shared.results import write_records
from shared.scenes import EIGHT, read_pairs

HELD_OUT = ("Baby1", "Midd1")  # of the 2006 release: every setting was chosen on them and on rendered pairs
TRAINING_SEED, TEST_SEED = 1, 2  # of the rendered pairs


@dataclass(frozen=True)
class ExperimentConfig:
    """How much is trained on what."""

    num_rendered: int = 16
    num_seeds: int = 3
    training: TrainingConfig = field(default_factory=TrainingConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)


QUICK = ExperimentConfig(
    num_rendered=8,
    num_seeds=1,
    training=TrainingConfig(steps=90, pairs_per_step=1, crop_height_px=56, crop_width_px=144),
)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Pairs to train on, their putative matches, and pairs to test on."""

    pairs: list[ts.StereoPair]
    labels: PseudoLabels
    test: list[ts.StereoPair]
    config: ExperimentConfig

    def runs(self) -> Iterator[tuple[str, int, TrainedNet]]:
        """Train under every condition; of one seed, conditions differ in their labels alone."""
        for seed in range(self.config.num_seeds):
            for condition in CONDITIONS:
                labels = self.labels.of_condition(condition)
                yield condition, seed, train(self.pairs, labels, self.config.training, seed)


def prepare(config: ExperimentConfig, data: Path | None = None, *, held_out: bool = False) -> Experiment:
    """Rendered pairs alone, or with the 2006 scenes of ``data``; test on unseen rendered pairs or the paper's eight.

    ``held_out`` tests on unseen rendered pairs and the held-out scenes of 2006: the place to choose settings.
    """
    rendered, unseen = SyntheticDataset(config.num_rendered, seed=TRAINING_SEED), SyntheticDataset(4, seed=TEST_SEED)
    pairs = [rendered[k] for k in range(len(rendered))]
    test = [unseen[k] for k in range(len(unseen))] if data is None or held_out else []
    if data is not None:
        real = read_pairs(data / "middlebury" / "2006")
        pairs += [pair for pair in real if pair.name not in HELD_OUT]
        test += [p for p in real if p.name in HELD_OUT] if held_out else read_pairs(data / "middlebury", EIGHT)
    return Experiment(pairs, make_pseudo_labels(pairs), test, config)


def label_records(labels: PseudoLabels) -> list[dict]:
    return [{"title": "labels", "condition": c, **labels.summary(c)} for c in CONDITIONS]


def training_record(condition: str, seed: int, trained: TrainedNet, test: Sequence[ts.StereoPair]) -> dict:
    """Errors of one network, the mean over the scenes and each of them."""
    scenes = trained.errors(test)
    means = {key: statistics.mean(errors[key] for errors in scenes.values()) for key in ("epe_px", "bad_2px")}
    tail = trained.losses[-max(1, len(trained.losses) // 10) :]
    losses = {"first_loss_px": trained.losses[0], "last_loss_px": statistics.mean(tail)}
    return {"title": "training", "condition": condition, "seed": seed, **means, **losses, "scenes": scenes}


def summarize(runs: Sequence[dict]) -> list[dict]:
    """Mean and spread over the seeds, also of the difference to ``none`` with the same seed."""
    of = {(run["condition"], run["seed"]): run for run in runs}
    seeds = sorted({run["seed"] for run in runs})
    records = []
    for condition in CONDITIONS:
        record: dict = {"title": "summary", "condition": condition, "seeds": len(seeds)}
        for key in ("epe_px", "bad_2px"):
            values = [of[condition, seed][key] for seed in seeds]
            gains = [of[condition, seed][key] - of["none", seed][key] for seed in seeds]
            record[key] = spread(values)
            record[f"{key}_minus_none"] = spread(gains)
        records.append(record)
    return records


def spread(values: Sequence[float]) -> dict[str, float]:
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return {"mean": statistics.mean(values), "std": deviation, "min": min(values), "max": max(values)}


def print_tables(records: Sequence[dict]) -> None:
    """The tables of a run, from what it wrote."""
    labels = {r["condition"]: r for r in records if r["title"] == "labels"}
    print("| labels | per pair | correct | weighted | EPE px | minus none | bad 2 px | minus none |")
    print("|:-------|---------:|--------:|---------:|-------:|-----------:|---------:|-----------:|")
    for record in (r for r in records if r["title"] == "summary"):
        of = labels[record["condition"]]
        cells = [record["condition"], f"{of['labels_per_pair']:.0f}", f"{of['fraction_correct']:.2f}"]
        cells.append(f"{of['weighted_fraction_correct']:.2f}")
        for key, digits in (("epe_px", 2), ("bad_2px", 3)):
            for name, sign in ((key, ""), (f"{key}_minus_none", "+")):
                cells.append(f"{record[name]['mean']:{sign}.{digits}f} ± {record[name]['std']:.{digits}f}")
        print("| " + " | ".join(cells) + " |")
    print()
    print("| set | axes | cost | matches | mean px before | after | median px before | after | better |")
    print("|:----|:-----|:-----|--------:|---------------:|------:|-----------------:|------:|-------:|")
    for record in (r for r in records if r["title"] == "refinement"):
        cells = [record["set"], record["axes"], record["cost"], str(record["matches"])]
        if "skipped" in record:
            cells += [record["skipped"], "", "", "", ""]
        else:
            keys = ("mean_before_px", "mean_after_px", "median_before_px", "median_after_px")
            cells += [*(f"{record[key]:.3f}" for key in keys), f"{record['fraction_better']:.2f}"]
        print("| " + " | ".join(cells) + " |")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("TENSOR_STEREO_DATA"))
    parser.add_argument("--seeds", type=int, help="networks per condition")
    parser.add_argument("--steps", type=int, help="of training, per network")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="rendered pairs only, one seed; writes no file")
    parser.add_argument("--held-out", action="store_true", help="test where settings may be chosen; writes no file")
    options = parser.parse_args()
    if not options.quick and options.data is None:
        parser.error("--data or TENSOR_STEREO_DATA must name the folder with middlebury/, unless --quick is given")
    return options


def main() -> None:
    options = parse_arguments()
    torch.set_num_threads(options.threads)
    config = QUICK if options.quick else ExperimentConfig()
    config = replace(config, num_seeds=options.seeds or config.num_seeds)
    config = replace(config, training=replace(config.training, steps=options.steps or config.training.steps))
    start = time.perf_counter()
    experiment = prepare(config, None if options.quick else options.data, held_out=options.held_out)
    records, runs = label_records(experiment.labels), []
    for condition, seed, trained in experiment.runs():
        run = training_record(condition, seed, trained, experiment.test)
        runs.append(run)
        losses = f"loss {run['first_loss_px']:.2f} -> {run['last_loss_px']:.2f} px"
        errors = f"EPE {run['epe_px']:.3f} px, bad 2 px {run['bad_2px']:.3f}"
        print(f"{time.perf_counter() - start:6.0f} s  seed {seed} {condition:7} {losses}  {errors}", flush=True)
    records += runs + summarize(runs)
    for name in ("synthetic",) if options.quick else ("synthetic", "middlebury-2006"):
        pairs = [pair for pair in experiment.pairs if pair.dataset == name][:8]
        records += refine_pairs(pairs, config.refinement, set_name=name)
    print_tables(records)
    print(f"{time.perf_counter() - start:.0f} s")
    if not options.quick and not options.held_out:
        write(records, experiment, options)


def write(records: list[dict], experiment: Experiment, options: argparse.Namespace) -> None:
    """Write results/label_training.json with the metadata of the run."""
    write_records(
        "label_training",
        records,
        threads=options.threads,
        settings=asdict(experiment.config),
        median_threshold_px=experiment.labels.median_threshold_px,
        training_pairs=[f"{pair.dataset}/{pair.name}" for pair in experiment.pairs],
        test_pairs=[pair.name for pair in experiment.test],
    )


if __name__ == "__main__":
    main()
