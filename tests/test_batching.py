from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.batching import (
    batch_to_ptr,
    collate_matches,
    concatenate_features,
    from_padded,
    lengths_to_ptr,
    ptr_to_batch,
    select_matches,
    split,
    to_padded,
)
from tensor_stereo.types import Matches

lengths = st.lists(st.integers(0, 4), max_size=6)


@given(lengths, st.integers(0, 3))
def test_padding_and_back(lengths: list[int], extra: int) -> None:
    ptr = lengths_to_ptr(torch.tensor(lengths, dtype=torch.int64))
    values = torch.arange(int(ptr[-1]) * 2, dtype=torch.float64).reshape(-1, 2)
    padded, mask = to_padded(values, ptr, num_rows=max(lengths, default=0) + extra, fill=float("nan"))
    assert mask.sum(1).tolist() == lengths
    back, back_ptr = from_padded(padded, mask)
    assert torch.equal(back, values)
    assert torch.equal(back_ptr, ptr)


@given(lengths)
def test_batch_vector_and_back(lengths: list[int]) -> None:
    ptr = lengths_to_ptr(torch.tensor(lengths, dtype=torch.int64))
    assert torch.equal(batch_to_ptr(ptr_to_batch(ptr), num_pairs=len(lengths)), ptr)
    assert [len(part) for part in split(ptr_to_batch(ptr), ptr)] == lengths


def test_gradients_flow_through_padding() -> None:
    values = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    ptr = torch.tensor([0, 1, 3])
    assert torch.autograd.gradcheck(lambda v: to_padded(v, ptr)[0], values)
    padded, mask = to_padded(values.detach(), ptr)
    assert torch.autograd.gradcheck(lambda p: from_padded(p, mask)[0], padded.requires_grad_())


def test_mask_may_have_holes() -> None:
    mask = torch.tensor([[True, False, True], [False, True, False]])
    values, ptr = from_padded(torch.arange(6).reshape(2, 3), mask)
    assert values.tolist() == [0, 2, 4]
    assert ptr.tolist() == [0, 2, 3]


def test_selection_keeps_empty_pairs() -> None:
    matches = Matches(torch.rand(4, 2), torch.rand(4, 2), torch.tensor([0, 1, 1, 4]), group=torch.arange(4))
    chosen = select_matches(matches, torch.tensor([False, True, False, True]))
    assert chosen.ptr.tolist() == [0, 0, 0, 2]
    assert chosen.group is not None
    assert chosen.group.tolist() == [1, 3]


def test_bad_input_is_named() -> None:
    plain = Matches(torch.rand(1, 2), torch.rand(1, 2), torch.tensor([0, 1]))
    costly = Matches(torch.rand(1, 2), torch.rand(1, 2), torch.tensor([0, 1]), cost=torch.rand(1))
    with pytest.raises(ValueError, match="cost must be given by all items or by none; item 0"):
        collate_matches([plain, costly])
    with pytest.raises(ValueError, match="items"):
        collate_matches([])
    with pytest.raises(ValueError, match="items"):
        concatenate_features([])
    with pytest.raises(ValueError, match="num_rows"):
        to_padded(torch.rand(3), torch.tensor([0, 3]), num_rows=2)
    with pytest.raises(ValueError, match="batch"):
        batch_to_ptr(torch.tensor([1, 0]))
    with pytest.raises(ValueError, match="batch"):
        batch_to_ptr(torch.tensor([0, 2]), num_pairs=2)
    with pytest.raises(TypeError, match="mask"):
        from_padded(torch.rand(1, 2), torch.ones(1, 2))
    with pytest.raises(TypeError, match="mask"):
        select_matches(plain, torch.ones(1))
