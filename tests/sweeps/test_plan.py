from __future__ import annotations

from pathlib import Path

import pytest

from tensor_stereo.configs import VERDICTS, SweepConfig, TrialConfig
from tensor_stereo.datasets import PairFiles
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.evaluation.rows import STAGES
from tensor_stereo.evaluation.trials import TrialRunner
from tensor_stereo.sweeps import Plan, build_plan, expand_grid

GRID = {
    "detector": ["fast", "gftt"],
    "fast": {"window_px": [9, 11]},
    "constrained": [False, True],
    "verdict": ["adjacency", "cardinality"],
    "outlier_rate": [0.0, 0.5],
    "score": "topology",
    "temperature": [0.5, 1.0],
}


def _plan(num_pairs: int) -> Plan:
    pairs = [PairFiles("set", str(k), Path("a"), Path("b")) for k in range(num_pairs)]
    return build_plan(SweepConfig(expand_grid([GRID])), pairs)


def test_every_trial_lies_in_one_group() -> None:
    plan = _plan(1)
    assert sorted(k for group in plan.groups for k in group) == list(range(len(plan.config.trials)))
    assert len(plan.groups) == 3  # FAST with two windows, GFTT


@pytest.mark.parametrize("count", [1, 2, 5])
def test_shards_are_a_partition_that_keeps_pairs_whole(count: int) -> None:
    plan = _plan(4)
    shards = [list(plan.shard(i, count)) for i in range(1, count + 1)]
    assert sorted(unit for shard in shards for unit in shard) == list(range(plan.num_units))
    pairs = [{plan.task(unit).files.scene for unit in shard} for shard in shards]
    assert sum(map(len, pairs)) == 4


@pytest.mark.parametrize("shard", [(0, 2), (3, 2), (1, 0)])
def test_a_shard_lies_within_its_number(shard: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="shard"):
        _plan(1).shard(*shard)


@pytest.mark.parametrize(
    ("config", "graphs", "scores"),
    [
        (SweepConfig(expand_grid([GRID])), 4, 8),
        (SweepConfig(expand_grid([{"verdict": ["score", "adjacency", "cardinality"]}])), 1, 1),
        (SweepConfig((TrialConfig(verdict="adjacency"), TrialConfig(verdict="cardinality"))), 1, 0),  # auto: no score
        (SweepConfig(tuple(TrialConfig(verdict=name, score="consensus") for name in VERDICTS)), 1, 1),
        (SweepConfig(expand_grid([{"score": "consensus", "consensus": {"slope": [0.1, 0.3]}}])), 1, 2),
    ],
)
def test_costs_are_what_a_runner_does(
    config: SweepConfig, graphs: int, scores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The runs of each stage that the plan promises, counted while the trials run."""
    import tensor_stereo.evaluation.trials as trials

    counted = dict.fromkeys(STAGES, 0)
    stages = {
        "detect": "detect_pairs", "match": "match_features", "perturb": "errors_against_gt",
        "group": "group_matches", "graph": "build_match_graphs", "relate": "classify_graphs", "score": "score_pairs",
    }  # fmt: skip
    for stage, name in stages.items():
        original = getattr(trials, name)

        def count(*args, original=original, stage=stage, **kwargs):
            counted[stage] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(trials, name, count)
    plan = build_plan(config, [PairFiles("set", "0", Path("a"), Path("b"))])
    pair = render_pair(0)
    for number, row in enumerate(plan.costs().iter_rows(named=True)):
        counted.update(dict.fromkeys(STAGES, 0))
        runner = TrialRunner(pair)
        for k in plan.groups[number]:
            runner.run(plan.config.trials[k])
        assert counted == {stage: row[stage] for stage in STAGES}
    assert row["detect"] == row["match"] == 1
    assert (row["graph"], row["score"]) == (graphs, scores)
