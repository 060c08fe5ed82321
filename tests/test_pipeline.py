from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tensor_stereo import DelaunayFilter
from tensor_stereo.classification import classify_graphs
from tensor_stereo.configs import DETECTORS, Detector, FilterConfig, MatchingConfig, PipelineConfig, Score
from tensor_stereo.datasets import PairDataset, find_pairs
from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset
from tensor_stereo.ops import backends
from tensor_stereo.pipeline import ImagePair, run_pipeline
from tensor_stereo.scores.domain import Domain, DomainWarning
from tensor_stereo.types import Relation
from tests.oracles import installed_backends, neighbor_sets, relation_of_sets

EIGHT = ("Art", "Books", "Cones", "Dolls", "Laundry", "Moebius", "Reindeer", "Teddy")


def _synthetic(num_pairs: int) -> list[ImagePair]:
    pairs = [(pair.image0, pair.image1) for pair in SyntheticDataset(num_pairs)]
    return [(a[:, 3 * k :], b[:, 3 * k :]) for k, (a, b) in enumerate(pairs)]  # as many sizes as pairs


def _assert_batch_equals_loop(pairs: list[ImagePair], config: PipelineConfig) -> None:
    batch = run_pipeline(pairs, config)
    loop = [run_pipeline([pair], config) for pair in pairs]
    for name in ("keypoints0", "keypoints1", "cost"):
        assert torch.equal(getattr(batch.matches, name), torch.cat([getattr(one.matches, name) for one in loop]))
    assert batch.matches.ptr.diff().tolist() == [one.matches.num_matches for one in loop]
    assert batch.score is not None
    torch.testing.assert_close(batch.score, torch.cat([one.score for one in loop]), rtol=0, atol=1e-4)  # type: ignore[misc]
    for name in ("relation", "overlap", "degree0", "degree1"):
        columns = [getattr(one.classification, name) for one in loop]
        assert torch.equal(getattr(batch.classification, name), torch.cat(columns)), name


def _assert_oracles_agree(pairs: list[ImagePair], config: PipelineConfig) -> None:
    """The sparse result is that of Python sets and of the dense boolean matrices (B, N, N)."""
    output = run_pipeline(pairs, config)
    graphs = output.graphs
    sets0, sets1 = neighbor_sets(graphs.adjacency0), neighbor_sets(graphs.adjacency1)
    literal = classify_graphs(graphs, FilterConfig(min_group_size=1))
    expected = [relation_of_sets(n0, n1) for n0, n1 in zip(sets0, sets1, strict=True)]
    alone = graphs.group_size == 1
    untested = (graphs.group_size == 0) | (~alone & ((literal.degree0 == 0) | (literal.degree1 == 0)))
    expected = ["UNTESTED" if u else name for u, name in zip(untested.tolist(), expected, strict=True)]
    assert [Relation(value).name for value in literal.relation.tolist()] == expected
    longest = int(output.matches.ptr.diff().max())
    dense = torch.zeros(2, len(pairs), longest, longest, dtype=torch.bool)
    for b in range(len(pairs)):
        for view, adjacency in enumerate((graphs.adjacency0, graphs.adjacency1)):
            block = adjacency.to_dense(b)
            dense[view, b, : len(block), : len(block)] = block
    overlap = (dense[0] & dense[1]).sum(-1)
    rows = torch.cat([overlap[b, :n] for b, n in enumerate(output.matches.ptr.diff().tolist())])
    assert torch.equal(output.classification.overlap, rows)


@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("detector", ["fast", "gftt"])
def test_batch_of_several_sizes_equals_loop(detector: Detector, constrained: bool) -> None:
    _assert_batch_equals_loop(_synthetic(3), PipelineConfig(detector=detector, constrained=constrained))


@pytest.mark.parametrize("constrained", [False, True])
def test_oracles_agree_on_synthetic_pairs(constrained: bool) -> None:
    _assert_oracles_agree(_synthetic(2), PipelineConfig(constrained=constrained))


@pytest.mark.slow
@pytest.mark.parametrize("detector", DETECTORS)
def test_eight_scenes_in_one_batch_equal_eight_runs_and_the_oracles(detector: Detector, data_root: Path) -> None:
    dataset = PairDataset(find_pairs(data_root / "middlebury", scenes=EIGHT))
    pairs = [(pair.image0, pair.image1) for pair in dataset]
    assert len({image.shape for image, _ in pairs}) == 3
    for constrained in (False, True):
        config = PipelineConfig(detector=detector, constrained=constrained)
        _assert_batch_equals_loop(pairs, config)
        _assert_oracles_agree(pairs, config)


class Unusable:
    """In the place of the compiled module: whoever asks for a kernel fails."""

    def __getattr__(self, name: str) -> object:
        raise AssertionError(f"the kernel {name} ran under backend='scipy'")


@pytest.mark.parametrize("score", ["learned", "consensus", "topology"])
def test_under_scipy_no_kernel_runs_from_images_to_verdicts(score: Score, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = SyntheticDataset(1)[0]
    pairs = [(pair.image0[:, :120, :160], pair.image1[:, :120, :160])]
    gates = MatchingConfig(max_row_offset_px=1, min_disparity_px=0, max_disparity_px=64)
    configs = [
        PipelineConfig(backend=backend, score=score, threshold=0.4, matching=gates, constrained=constrained)
        for constrained in (False, True)
        for backend in ("auto", "scipy")
    ]
    native = [run_pipeline(pairs, config) for config in configs[::2]]
    monkeypatch.setattr(backends, "kernels", Unusable())
    for config, expected in zip(configs[1::2], native, strict=True):
        output = run_pipeline(pairs, config)
        assert torch.equal(output.classification.relation, expected.classification.relation)
        torch.testing.assert_close(output.score, expected.score, rtol=0, atol=1e-6)
    if installed_backends()[0] == "native":
        with pytest.raises(AssertionError, match=r"the kernel .* ran"):
            run_pipeline(pairs, configs[0])


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_default_dtype_of_torch_changes_nothing(detector: Detector) -> None:
    pair = SyntheticDataset(1)[0]
    pairs = [(pair.image0[:, :150, :200], pair.image1[:, :150, :200])]
    configs = [
        PipelineConfig(detector=detector, constrained=True),
        PipelineConfig(detector=detector, score="consensus", matching=MatchingConfig(max_row_offset_px=1)),
        PipelineConfig(detector=detector, verdict="cardinality", score="topology"),
    ]
    expected = [run_pipeline(pairs, config) for config in configs]
    torch.set_default_dtype(torch.float64)
    try:
        for config, before in zip(configs, expected, strict=True):
            found = run_pipeline(pairs, config)
            for name in ("keypoints0", "keypoints1", "cost"):
                assert getattr(found.matches, name).dtype == torch.float32
                assert torch.equal(getattr(found.matches, name), getattr(before.matches, name)), name
            assert torch.equal(found.classification.relation, before.classification.relation)
            assert found.score.dtype == before.score.dtype
            assert torch.equal(found.score, before.score)
        module = DelaunayFilter(trainable=True)
        output = module(before.matches, images0=pairs[0][0], images1=pairs[0][1])
        assert output.score.dtype == torch.float32
        assert {parameter.dtype for parameter in module.parameters()} == {torch.float32}
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("detector", DETECTORS)
def test_constant_and_tiny_images_give_empty_results(detector: Detector) -> None:
    config = PipelineConfig(detector=detector, constrained=True)
    for size in ((64, 80), (1, 1), (7, 300)):
        image = torch.full((1, *size), 90, dtype=torch.uint8)
        output = run_pipeline([(image, image)], config)
        assert output.matches.keypoints0.shape == (0, 2)
        assert output.classification.inlier.shape == (0,)
        assert output.matches.ptr.tolist() == [0, 0]


def test_one_keypoint_is_untested() -> None:
    image = torch.randint(0, 256, (1, 60, 60), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    output = run_pipeline([(image, image)], PipelineConfig(fast=replace(PipelineConfig().fast, max_keypoints=1)))
    assert output.matches.num_matches == 1
    assert output.classification.relation.tolist() == [Relation.UNTESTED]


def test_views_of_different_size_are_named() -> None:
    image = torch.zeros(1, 60, 60, dtype=torch.uint8)
    with pytest.raises(ValueError, match="image0 and image1 of pair 1"):
        run_pipeline([(image, image), (image, image[:, :50])])
    with pytest.raises(ValueError, match="pairs must hold at least one pair"):
        run_pipeline([])


def test_a_true_disparity_is_kept_more_often_than_a_wrong_one() -> None:
    from tensor_stereo.evaluation import match_rates, matches_against_gt

    dataset = list(SyntheticDataset(3))
    output = run_pipeline([(pair.image0, pair.image1) for pair in dataset])
    truth = matches_against_gt(output.matches, [pair.disparity_gt for pair in dataset])  # type: ignore[misc]
    rates = match_rates(output.classification.inlier, *truth)
    assert rates.sensitivity + rates.specificity > 1.8  # 1 is a coin toss, 2 is the truth


@pytest.mark.parametrize("score", ["learned", "consensus"])
def test_one_run_gives_the_probability_at_every_tolerance(score: Score) -> None:
    pairs = [(pair.image0, pair.image1) for pair in SyntheticDataset(2)]
    output = run_pipeline(pairs, PipelineConfig(score=score))
    assert output.cumulative.shape == (output.matches.num_matches, 5)
    assert output.alignment.fitted.tolist() == [True, True]
    assert output.domain.tolist() == [0, 0]
    assert torch.equal(output.probability(1), output.score)
    wide = run_pipeline(pairs, PipelineConfig(score=score, max_error_px=2.5))
    assert torch.equal(output.probability(2.5), wide.score)
    assert (output.probability(5) >= output.score).all()


def test_a_pair_of_two_scenes_is_marked() -> None:
    one, other = SyntheticDataset(2)
    with pytest.warns(DomainWarning, match="those of pair 1 hardly do"):
        output = run_pipeline([(one.image0, one.image1), (one.image0, other.image1)])
    assert output.domain.tolist() == [0, Domain.AGREEMENT]
    plain = run_pipeline([(one.image0, other.image1)], PipelineConfig(verdict="cardinality"))
    assert plain.domain is plain.cumulative is plain.alignment is None
    with pytest.raises(ValueError, match="score must be 'learned' or 'consensus'"):
        plain.probability(1.0)
