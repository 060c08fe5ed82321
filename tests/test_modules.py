"""DelaunayFilter as a module: layouts, padding, training, saving, compiling."""

from __future__ import annotations

import copy
import io
import pickle
import shutil

import pytest
import torch

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches, split_matches, to_padded
from tests.test_classification import random_pair

NAN = float("nan")


def _padded(num_pairs: int = 3, num_rows: int = 40, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    left = torch.rand(num_pairs, num_rows, 2, generator=generator) * 100
    right = left - torch.tensor([5.0, 0.0])
    right[:, ::4] = torch.rand(num_pairs, len(range(0, num_rows, 4)), 2, generator=generator) * 100
    return left, right


def _wrong_at_random(matches: ts.Matches) -> ts.Matches:
    """Move some matches of view 1, so that scores are neither 0 nor 1."""
    moved = matches.keypoints1.clone()
    moved[::3] += 40 * torch.sin(torch.arange(len(moved[::3]), dtype=moved.dtype))[:, None]
    return ts.Matches(matches.keypoints0, moved, matches.ptr, matches.cost, matches.group)


BATCH = [random_pair("integer", seed, n) for seed, n in enumerate((50, 1, 0, 2, 3, 30))]


@pytest.mark.parametrize("score", ["topology", "consensus"])
def test_batch_equals_loop_bit_for_bit(score: str) -> None:
    batch = _wrong_at_random(collate_matches(BATCH))
    leaf = batch.keypoints1.clone().requires_grad_()
    module = ts.DelaunayFilter(score=score, threshold=0.5)
    output = module(ts.Matches(batch.keypoints0, leaf, batch.ptr, batch.cost))
    output.score.sum().backward()
    assert leaf.grad is not None
    start = 0
    for one in split_matches(batch):
        rows = slice(start, start + one.num_matches)
        alone = one.keypoints1.clone().requires_grad_()
        expected = module(ts.Matches(one.keypoints0, alone, one.ptr, one.cost))
        expected.score.sum().backward()
        assert torch.equal(output.score[rows], expected.score)
        assert torch.equal(output.inlier[rows], expected.inlier)
        assert torch.equal(leaf.grad[rows], alone.grad if alone.grad is not None else torch.zeros_like(alone))
        start = rows.stop
    assert 0 < float(output.score.detach().mean()) < 1


def test_batch_equals_loop_up_to_single_precision_for_learned() -> None:
    batch = _wrong_at_random(collate_matches(BATCH))
    module = ts.DelaunayFilter()
    alone = torch.cat([module(one).score for one in split_matches(batch)])
    torch.testing.assert_close(module(batch).score, alone, rtol=0, atol=1e-4)


@pytest.mark.parametrize("fill", [0.0, NAN, 1e300])
@pytest.mark.parametrize("extra", [0, 7])
def test_padding_changes_no_value_and_no_gradient(fill: float, extra: int) -> None:
    batch = _wrong_at_random(collate_matches(BATCH))
    num_rows = max(one.num_matches for one in BATCH) + extra
    (k0, mask), (k1, _), (cost, _) = (
        to_padded(v, batch.ptr, num_rows=num_rows, fill=fill if v.ndim == 2 else NAN)
        for v in (batch.keypoints0, batch.keypoints1, batch.cost)  # type: ignore[arg-type]
    )
    k1 = k1.requires_grad_()
    ragged = batch.keypoints1.clone().requires_grad_()
    module = ts.DelaunayFilter()
    output = module(k0, k1, mask, cost=cost)
    expected = module(ts.Matches(batch.keypoints0, ragged, batch.ptr, batch.cost))
    output.score.square().sum().backward()
    expected.score.square().sum().backward()
    assert torch.equal(output.score[mask], expected.score)
    assert torch.equal(output.relation[mask], expected.relation)
    assert output.score[~mask].eq(0).all()
    assert output.relation[~mask].eq(int(ts.Relation.UNTESTED)).all()
    assert k1.grad is not None
    assert torch.equal(k1.grad[mask], ragged.grad)
    assert k1.grad[~mask].eq(0).all()


@pytest.mark.parametrize("shape", [(0, 5), (2, 0), (2, 1), (2, 2), (2, 3)])
@pytest.mark.parametrize("masked", [False, True])
def test_too_few_matches_score_zero_with_zero_gradient(shape: tuple[int, int], masked: bool) -> None:
    left, right = _padded(*shape)
    right = right.requires_grad_()
    mask = torch.zeros(shape, dtype=torch.bool) if masked else None
    output = ts.DelaunayFilter()(left, right, mask)
    assert output.inlier.shape == output.score.shape == output.relation.shape == shape
    assert not output.inlier.any()
    output.score.sum().backward()
    assert right.grad is not None
    assert right.grad.shape == right.shape
    assert not right.grad.any()
    assert not output.score.detach().any()


def test_score_is_the_same_in_both_precisions_of_equal_coordinates() -> None:
    left, right = _padded()
    single, double = ts.DelaunayFilter()(left, right), ts.DelaunayFilter()(left.double(), right.double())
    assert single.score.dtype == torch.float32
    assert double.score.dtype == torch.float64
    assert torch.equal(single.score, double.score.float())
    assert torch.equal(single.inlier, double.inlier)


def test_straight_through_has_the_hard_verdict_and_the_soft_gradient() -> None:
    left, right = _padded()
    gradients = []
    for straight in (False, True):
        leaf = right.clone().requires_grad_()
        output = ts.DelaunayFilter(straight_through=straight)(left, leaf)
        output.score.sum().backward()
        gradients.append(leaf.grad)
    assert torch.equal(output.score.detach(), output.inlier.float())
    assert gradients[0] is not None
    assert gradients[0].any()
    assert torch.equal(*gradients)


@pytest.mark.parametrize("score", ["auto", "consensus", "learned"])
def test_a_match_is_kept_from_probability_one_half_or_the_threshold_on(score: str) -> None:
    left, right = _padded()
    for threshold, least in ((None, 0.5), (0.9, 0.9), (0.0, 0.0)):
        module = ts.DelaunayFilter(score=score, threshold=threshold)
        output = module(left, right)
        tested = output.relation != ts.Relation.UNTESTED
        assert torch.equal(output.inlier, tested & (output.score >= least))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            low = module(left, right)
        assert torch.equal(low.inlier, (low.relation != ts.Relation.UNTESTED) & (low.score >= least))


@pytest.mark.parametrize("restriction", ["adjacency", "cardinality"])
def test_the_verdicts_of_the_paper_are_those_of_classify_matches(restriction: str) -> None:
    matches = _wrong_at_random(collate_matches(BATCH))
    expected = ts.classify_matches(matches, restriction=restriction)  # type: ignore[arg-type]
    for score in ("auto", "none", "consensus", "learned"):
        output = ts.DelaunayFilter(verdict=restriction, score=score)(matches)
        assert torch.equal(output.inlier, expected.inlier)
        assert torch.equal(output.relation, expected.relation)
        assert (output.score is None) == (score == "none")
    assert torch.equal(ts.DelaunayFilter()(matches).relation, expected.relation)
    soft = ts.DelaunayFilter(verdict=restriction, score="topology")(matches).score
    assert torch.equal(ts.DelaunayFilter(verdict=restriction)(matches).score, soft)


def test_temperature_can_be_learnt() -> None:
    left, right = _padded()
    module = ts.DelaunayFilter(verdict="cardinality", temperature=0.5, learnable_temperature=True)
    optimizer = torch.optim.SGD(module.parameters(), lr=0.01)
    before = module(left, right).score.mean()
    before.neg().backward()
    optimizer.step()
    assert module.temperature.item() != 0.5
    assert module(left, right).score.mean() > before
    assert not list(ts.DelaunayFilter(score="consensus").parameters())


def test_state_survives_saving_copying_and_pickling() -> None:
    left, right = _padded()
    module = ts.DelaunayFilter(verdict="adjacency", temperature=0.7, learnable_temperature=True)
    expected = module(left, right)
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    restored = ts.DelaunayFilter(verdict="adjacency", learnable_temperature=True)
    restored.load_state_dict(torch.load(file, weights_only=True))
    for other in (restored, copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert torch.equal(other(left, right).score, expected.score)
        assert torch.equal(other(left, right).inlier, expected.inlier)


def test_inference_mode_and_autocast_change_no_verdict() -> None:
    left, right = _padded()
    module = ts.DelaunayFilter()
    expected = module(left, right)
    with torch.inference_mode():
        assert torch.equal(module(left, right).score, expected.score)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = module(left, right)
    assert low.score.dtype == torch.bfloat16
    assert torch.equal(low.inlier, expected.inlier)
    assert torch.equal(low.score, expected.score.bfloat16())


def test_inliers_feed_the_next_filter() -> None:
    left, right = _padded()
    mask = torch.rand(left.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.8
    right = right.requires_grad_()
    first = ts.DelaunayFilter()(left, right, mask)
    kept = first.to_matches()
    assert kept.num_pairs == len(left)
    assert torch.equal(kept.keypoints0, left[first.inlier])
    second = ts.DelaunayFilter(min_group_size=1)(kept)
    assert second.inlier.shape == (int(first.inlier.sum()),)
    third = second.to_matches()
    assert torch.equal(third.keypoints0, kept.keypoints0[second.inlier])
    kept.keypoints1.sum().backward()
    assert right.grad is not None
    assert torch.equal(right.grad.bool().all(-1), first.inlier)


def test_unrectified_pairs_and_negative_disparities_are_like_any_other() -> None:
    left, right = (points.double() for points in _padded())
    turn = torch.tensor([[0.8, 0.6], [-0.6, 0.8]], dtype=torch.float64)
    expected = ts.DelaunayFilter(verdict="cardinality")(left, right)
    for moved in (right + torch.tensor([50.0, 0.0]), right @ turn * 1.5, right.flip(-1)):
        output = ts.DelaunayFilter(verdict="cardinality")(left, moved)
        assert torch.equal(output.inlier, expected.inlier)
        assert torch.allclose(output.score, expected.score, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"score": "consensus", "min_precision": 0.9},
        {"score": "topology", "learnable_temperature": True, "threshold": 0.4},
    ],
)
def test_the_module_compiles_without_a_graph_break(settings: dict[str, object]) -> None:
    _compare_compiled("aot_eager", settings)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler uses parts of torch that torch deprecates
def test_the_module_compiles_with_inductor() -> None:
    _compare_compiled("inductor", {"score": "topology", "learnable_temperature": True, "threshold": 0.4})


def _compare_compiled(backend: str, settings: dict[str, object]) -> None:
    torch.compiler.reset()
    module = ts.DelaunayFilter(**settings)  # type: ignore[arg-type]

    def loss(left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, ...]:
        output = module(left, right)
        value = output.score.square().sum()
        if output.cumulative is not None:
            value = value + output.probability(2.5).sum()
        return value, output.inlier, output.relation, output.relation if output.domain is None else output.domain

    results = []
    for function in (loss, torch.compile(loss, fullgraph=True, backend=backend)):
        left, right = _padded(num_rows=30)
        right.requires_grad_()
        value, inlier, relation, domain = function(left, right)
        value.backward()
        results.append((value, inlier, relation, right.grad, domain))
    (value, inlier, relation, gradient, domain), compiled = results
    assert torch.allclose(value, compiled[0], rtol=1e-6)
    assert torch.equal(inlier, compiled[1])
    assert torch.equal(relation, compiled[2])
    assert torch.allclose(gradient, compiled[3], rtol=1e-5, atol=1e-7)
    assert torch.equal(domain, compiled[4])


@pytest.mark.gpu
def test_cuda_tensors_come_back_on_their_device() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    left, right = _padded()
    expected = ts.DelaunayFilter()(left, right)
    leaf = right.cuda().requires_grad_()
    output = ts.DelaunayFilter().cuda()(left.cuda(), leaf)
    assert output.score.device == output.inlier.device == leaf.device
    assert torch.equal(output.inlier.cpu(), expected.inlier)
    output.score.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()


def test_a_move_to_another_dtype_keeps_the_temperature() -> None:
    for module in (
        ts.DelaunayFilter(verdict="cardinality", temperature=3.0),
        ts.DelaunayFilter(verdict="cardinality", temperature=3.0, learnable_temperature=True),
    ):
        assert module.half().temperature.item() == pytest.approx(3.0, rel=1e-15)
        assert module.temperature.dtype == torch.float64
