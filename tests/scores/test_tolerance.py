from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.configs import FilterConfig
from tensor_stereo.scores.tolerance import TOLERANCES_PX, probability_within, rising

tolerances = st.floats(0.5, 5)
rows = st.lists(st.floats(0, 1, width=32), min_size=5, max_size=5).map(sorted)


@given(rows, tolerances, tolerances, st.sampled_from([torch.float32, torch.float64]))
def test_the_probability_never_falls_with_the_tolerance(
    row: list[float], one: float, other: float, dtype: torch.dtype
) -> None:
    cumulative = torch.tensor([row], dtype=dtype)
    less, more = (probability_within(cumulative, e) for e in sorted((one, other)))
    assert less.dtype == dtype
    assert (less <= more).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("knot", TOLERANCES_PX[1:])
def test_no_rounding_lifts_it_above_the_next_tolerance(knot: float, dtype: torch.dtype) -> None:
    logits = 3 * torch.randn(10_000, 5, generator=torch.Generator().manual_seed(0), dtype=dtype)
    cumulative = rising(logits.sigmoid().unbind(-1))
    for below in (np.nextafter(knot, 0), knot - 1e-9, knot - 1e-7):
        assert (probability_within(cumulative, float(below)) <= probability_within(cumulative, knot)).all()


@given(rows, tolerances)
def test_it_is_linear_between_the_tolerances(row: list[float], max_error_px: float) -> None:
    found = probability_within(torch.tensor(row, dtype=torch.float64), max_error_px)
    assert float(found) == pytest.approx(np.interp(max_error_px, TOLERANCES_PX, row), abs=1e-12)


@pytest.mark.parametrize("k", range(5))
def test_at_a_tolerance_it_is_the_prediction_bit_for_bit(k: int) -> None:
    cumulative = rising(torch.rand(50, 5, generator=torch.Generator().manual_seed(k)).unbind(1))
    assert torch.equal(probability_within(cumulative, TOLERANCES_PX[k]), cumulative[:, k])


def test_gradients_flow_to_both_tolerances_around() -> None:
    cumulative = torch.tensor([0.1, 0.2, 0.5, 0.6, 0.9], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(probability_within(cumulative, 4.5), cumulative)
    torch.testing.assert_close(gradient, torch.tensor([0, 0, 0, 0.25, 0.75], dtype=torch.float64))


@pytest.mark.parametrize("max_error_px", [0.4, 5.1, -1.0, float("nan"), float("inf")])
def test_other_tolerances_are_refused_by_name(max_error_px: float) -> None:
    with pytest.raises(ValueError, match=r"max_error_px must lie between 0.5 and 5 px, got"):
        probability_within(torch.zeros(5), max_error_px)
    with pytest.raises(ValueError, match=r"max_error_px must lie in \[0.5, 5\], got"):
        FilterConfig(max_error_px=max_error_px)


def test_a_similarity_is_refused() -> None:
    with pytest.raises(ValueError, match="score must be 'learned' or 'consensus', which are probabilities"):
        probability_within(None, 1.0)


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5))
def test_rising_lifts_only_what_falls(row: list[float]) -> None:
    found = rising(torch.tensor(row, dtype=torch.float64).unbind()).tolist()
    assert found == np.maximum.accumulate(row).tolist()
