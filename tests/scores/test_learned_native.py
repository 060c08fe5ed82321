"""The kernel of the learned score says what the torch network says, and stays away where a gradient is asked for."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from tensor_stereo import Matches
from tensor_stereo.batching import select_pairs
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import LearnedScore, load_learned, measure_images, score_learned
from tensor_stereo.scores.alignment import estimate_alignment
from tensor_stereo.scores.image_evidence import ImageEvidence
from tensor_stereo.scores.learned_native import pack_weights, runs_natively
from tests.oracles import installed_backends
from tests.scores.learned_oracle import random_pairs
from tests.scores.test_image_evidence import textured_views

pytestmark = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
ATOL = 1e-5  # of logits up to 12 in float32, sums of some hundred products in another order


def both(
    matches: Matches,
    evidence: ImageEvidence | None = None,
    *,
    rectified: bool = True,
    network: LearnedScore | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits by the kernel and by torch."""
    graphs = build_match_graphs(matches)
    alignment = estimate_alignment(matches, graphs, rectified=rectified)
    network = load_learned(rectified=rectified) if network is None else network
    found = [
        network(matches, graphs, evidence, FilterConfig(backend=name), alignment)[0] for name in ("native", "scipy")
    ]
    return found[0], found[1]


def assert_alike(found: tuple[torch.Tensor, torch.Tensor]) -> None:
    assert found[0].shape == found[1].shape
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=ATOL)


def evidence_of(matches: Matches) -> ImageEvidence:
    views = [[view] * matches.num_pairs for view in textured_views(1)]
    return measure_images(*views, matches, build_match_graphs(matches))


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("lengths", [(90,), (0, 40, 1, 2, 60), (3,), (1,), (0,), ()])
def test_logits_are_those_of_torch(lengths: tuple[int, ...], rectified: bool) -> None:
    matches = random_pairs(3, lengths)
    assert_alike(both(matches, rectified=rectified))
    assert_alike(both(matches, evidence_of(matches), rectified=rectified))


def test_costs_of_all_kinds() -> None:
    matches = random_pairs(4, (50, 30))
    generator = torch.Generator().manual_seed(0)
    cost = torch.rand(80, generator=generator, dtype=torch.float64)
    for given in (cost, (5 * cost).round(), cost - 0.5, cost.index_fill(0, torch.tensor([3]), torch.inf), None):
        assert_alike(both(replace(matches, cost=given)))


def test_duplicates_and_pairs_without_images() -> None:
    matches = random_pairs(5, (40, 40))
    left, right = matches.keypoints0.clone(), matches.keypoints1.clone()
    left[5], right[5] = left[6], right[6]
    matches = replace(matches, keypoints0=left, keypoints1=right)
    seen = evidence_of(matches)
    mixed = seen._replace(num_columns=torch.where(torch.arange(80) < 40, 0, seen.num_columns))
    assert_alike(both(matches, seen))
    assert_alike(both(matches, mixed))


def test_a_batch_is_its_pairs_one_by_one_whatever_the_threads() -> None:
    matches = random_pairs(6, (70, 50))
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        whole = both(matches)[0]
        torch.set_num_threads(1)
        assert torch.equal(whole, both(matches)[0])
    finally:
        torch.set_num_threads(threads)
    for b, (start, stop) in enumerate(((0, 70), (70, 120))):
        assert torch.equal(both(select_pairs(matches, b, b + 1))[0], whole[start:stop])


def test_weights_count_as_they_are_in_each_call() -> None:
    matches = random_pairs(7, (40,))
    network = LearnedScore().requires_grad_(False).eval()
    network.load_state_dict(load_learned().state_dict())
    before = both(matches, network=network)
    network.last.bias.data.add_(1)  # which no version of a tensor counts
    after = both(matches, network=network)
    assert_alike(after)
    assert (before[0] - after[0]).abs().max() > 0.5
    with torch.inference_mode():
        assert_alike(both(matches, network=copy.deepcopy(network)))


def test_hooks_run_in_torch() -> None:
    matches = random_pairs(7, (40,))
    network = copy.deepcopy(load_learned())
    network.last.register_forward_hook(lambda module, given, found: 0 * found)
    assert not runs_natively(network, matches, "native")
    assert_alike(both(matches, network=network))


@pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning")  # of torch's own forward mode
def test_tangents_and_gradients_of_evidence_stay_with_torch() -> None:
    matches = random_pairs(7, (40,))
    seen = evidence_of(matches)
    seen = seen._replace(values=seen.values.clone().requires_grad_())
    logit, _ = load_learned()(matches, build_match_graphs(matches), seen)
    logit.sum().backward()
    assert seen.values.grad is not None
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(matches.keypoints1, torch.ones_like(matches.keypoints1))
        assert not runs_natively(load_learned(), replace(matches, keypoints1=dual), "native")


def test_the_kernel_leaves_gradients_and_other_networks_to_torch() -> None:
    matches = random_pairs(8, (40,))
    graphs = build_match_graphs(matches)
    assert runs_natively(load_learned(), matches, "native")
    moved = replace(matches, keypoints1=matches.keypoints1.clone().requires_grad_())
    assert not runs_natively(load_learned(), moved, "native")
    with torch.no_grad():
        assert runs_natively(load_learned(), moved, "native")
    score_learned(moved, graphs).sum().backward()
    assert moved.keypoints1.grad is not None
    assert moved.keypoints1.grad.abs().sum() > 0
    assert not runs_natively(LearnedScore(), matches, "native")  # whose weights learn
    assert not runs_natively(LearnedScore(width=8).requires_grad_(False), matches, "native")
    assert not runs_natively(load_learned(), matches, "scipy")


def test_what_does_not_fit_is_refused() -> None:
    from tensor_stereo.ops.backends import native

    kernels = native("native")
    assert kernels is not None
    matches = random_pairs(9, (12,))
    patterns = [part.numpy() for part in build_match_graphs(matches).patterns]
    views = [view.double().numpy() for view in (matches.keypoints0, matches.keypoints1)]
    weights, ptr, rows = (
        pack_weights(load_learned()).numpy(),
        matches.ptr.numpy(),
        torch.ones(1, dtype=torch.bool).numpy(),
    )
    given = [weights, ptr, *views, rows, None, *patterns, *[None] * 6, 1]
    kernels.learned_network(*given)
    broken = patterns[1].copy()
    broken[0] = 12
    for place, value, message in (
        (0, weights[:-1], "weights must be those"),
        (1, ptr[:1], "ptr must rise|one entry per pair"),
        (3, views[1][:-1], "same length"),
        (7, broken, "cols must name matches"),
    ):
        wrong = list(given)
        wrong[place] = value
        with pytest.raises(ValueError, match=message):
            kernels.learned_network(*wrong)
