from __future__ import annotations

import numpy as np
import pytest
import torch

from tensor_stereo.evaluation import sparsification_area, sparsification_curve


def test_the_curve_is_that_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    score, wrong = rng.random(503), rng.random(503) < 0.3
    order = np.argsort(-score)
    for num in (1, 7, 20):
        kept = [int(np.ceil((k + 1) * 503 / num)) for k in range(num)]
        expected = [wrong[order[:count]].mean() for count in kept]
        found = sparsification_curve(torch.from_numpy(score), torch.from_numpy(wrong), num)
        assert np.allclose(found.numpy(), expected, rtol=0, atol=1e-15)
    assert found[-1] == wrong.mean()


def test_the_order_of_equal_scores_does_not_count() -> None:
    generator = torch.Generator().manual_seed(1)
    score = torch.randint(0, 5, (400,), generator=generator).float()
    wrong = torch.rand(400, generator=generator) < 0.4
    turn = torch.randperm(400, generator=generator)
    assert torch.equal(sparsification_curve(score, wrong), sparsification_curve(score[turn], wrong[turn]))
    flat = sparsification_curve(torch.zeros(400), wrong)
    assert torch.allclose(flat, wrong.double().mean().expand(20), rtol=0, atol=1e-12)


def test_no_score_is_better_than_the_errors_themselves() -> None:
    generator = torch.Generator().manual_seed(2)
    wrong = torch.rand(300, generator=generator) < 0.2
    best = sparsification_area(-wrong.float(), wrong)
    areas = [sparsification_area(torch.rand(300, generator=generator), wrong) for _ in range(50)]
    assert best < min(areas)
    assert sparsification_area(wrong.float(), wrong) > max(areas)


def test_bad_input_is_named() -> None:
    score, wrong = torch.rand(4), torch.zeros(4, dtype=torch.bool)
    with pytest.raises(ValueError, match="wrong must have shape"):
        sparsification_curve(score, wrong[:3])
    with pytest.raises(TypeError, match="wrong must be bool"):
        sparsification_curve(score, score)
    with pytest.raises(ValueError, match="score must not be NaN"):
        sparsification_curve(score * torch.nan, wrong)
    with pytest.raises(ValueError, match="num_shares"):
        sparsification_curve(score, wrong, 0)
    assert bool(sparsification_curve(score[:0], wrong[:0]).isnan().all())
