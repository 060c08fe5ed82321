from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.evaluation.perturbation import add_noise, inject_outliers
from tensor_stereo.types import Matches


def _matches(*lengths: int) -> Matches:
    draw = torch.Generator().manual_seed(0)
    left = torch.rand(sum(lengths), 2, generator=draw) * 100
    ptr = torch.tensor([0, *lengths]).cumsum(0)
    return Matches(left, left - torch.tensor([5.0, 0.0]), ptr, cost=torch.arange(float(sum(lengths))))


def _seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@given(st.lists(st.integers(0, 12), min_size=1, max_size=4), st.floats(0, 1), st.integers(0, 5))
def test_the_chosen_fraction_changes_partners_within_each_pair(lengths: list[int], rate: float, seed: int) -> None:
    matches = _matches(*lengths)
    bad = inject_outliers(matches, rate, _seeded(seed))
    assert torch.equal(bad.keypoints0, matches.keypoints0)
    changed = (bad.keypoints1 != matches.keypoints1).any(1)
    for start, stop in zip(matches.ptr.tolist(), matches.ptr.tolist()[1:], strict=False):
        chosen = int(rate * (stop - start) + 0.5)
        assert int(changed[start:stop].sum()) == (chosen if chosen > 1 else 0)
        before, after = (sorted(m.keypoints1[start:stop].tolist()) for m in (matches, bad))
        assert before == after  # a permutation: the matches stay one-to-one


def test_a_seed_decides() -> None:
    matches = _matches(50)
    first, same, other = (inject_outliers(matches, 0.5, _seeded(seed)).keypoints1 for seed in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_groups_of_the_old_partners_are_dropped() -> None:
    matches = _matches(4)
    grouped = Matches(matches.keypoints0, matches.keypoints1, matches.ptr, group=torch.arange(4))
    assert inject_outliers(grouped, 0.5, _seeded(0)).group is None


def test_noise_has_its_standard_deviation_and_stays_in_the_image() -> None:
    matches = _matches(20_000)
    noisy = add_noise(matches, 0.5, _seeded(0))
    for before, after in ((matches.keypoints0, noisy.keypoints0), (matches.keypoints1, noisy.keypoints1)):
        spread = (after - before).std(0)
        assert ((spread - 0.5).abs() < 4 * 0.5 / (2 * 20_000) ** 0.5).all()  # four standard errors
        assert after.dtype == before.dtype
    inside = add_noise(matches, 9.0, _seeded(0), [(90, 80)])
    for points in (inside.keypoints0, inside.keypoints1):
        assert (points >= 0).all()
        assert (points <= torch.tensor([79.0, 89.0])).all()


def test_gradients_reach_the_keypoints() -> None:
    left = torch.rand(6, 2, requires_grad=True)
    matches = Matches(left, left * 2, torch.tensor([0, 6]))
    add_noise(inject_outliers(matches, 1.0, _seeded(0)), 0.1, _seeded(0)).keypoints1.sum().backward()
    assert left.grad is not None
    assert (left.grad == 2).all()


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="rate"):
        inject_outliers(_matches(3), 1.1, _seeded(0))
    with pytest.raises(ValueError, match="noise_px"):
        add_noise(_matches(3), float("nan"), _seeded(0))
    with pytest.raises(ValueError, match="sizes"):
        add_noise(_matches(3), 1.0, _seeded(0), [(9, 9), (9, 9)])
