from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import Matches
from tensor_stereo.batching import collate_matches, split_matches
from tensor_stereo.interop import verdicts
from tensor_stereo.interop.verdicts import FilterSummary, Verdicts, filter_each, filter_matches
from tensor_stereo.modules import FilterOutput
from tests.interop.match_batches import batch, exact_filter, expected_exactly

sizes = st.lists(st.integers(0, 30), max_size=8)
seeds = st.integers(0, 10**6)


def assert_same(a: Verdicts, b: Verdicts) -> None:
    for name, one, other in zip(Verdicts._fields, a, b, strict=True):
        assert one.dtype == other.dtype, name
        np.testing.assert_array_equal(one, other, err_msg=name)


class Recorder:
    """DelaunayFilter that remembers what it was given."""

    def __init__(self) -> None:
        self.seen: list[Matches] = []

    def __call__(self, matches: Matches) -> FilterOutput:
        self.seen.append(matches)
        return exact_filter()(matches)


@given(seeds, sizes, st.integers(1, 70))
def test_blocks_hold_whole_pairs_and_change_nothing(seed: int, lengths: list[int], block: int) -> None:
    matches = batch(seed, lengths) if lengths else batch(seed, [5])
    recorder = Recorder()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdicts, "BLOCK_MATCHES", block)
        assert_same(filter_matches(matches, recorder), expected_exactly(matches))
    assert [n for part in recorder.seen for n in part.ptr.diff().tolist()] == matches.ptr.diff().tolist()
    assert all(part.num_matches <= block or part.num_pairs == 1 for part in recorder.seen)


def test_everything_that_fits_runs_at_once() -> None:
    recorder = Recorder()
    filter_matches(batch(0), recorder)
    assert [part.num_pairs for part in recorder.seen] == [5]


def test_a_batch_without_pairs_has_no_verdicts() -> None:
    empty = Matches(torch.zeros(0, 2), torch.zeros(0, 2), torch.tensor([0]))
    assert [len(values) for values in filter_matches(empty, exact_filter())] == [0, 0, 0]
    assert list(filter_each([], exact_filter())) == []


@given(seeds, sizes, st.integers(1, 70), st.sets(st.integers(0, 7)))
def test_a_stream_gets_the_verdicts_of_each_pair_alone(
    seed: int, lengths: list[int], block: int, without_cost: set[int]
) -> None:
    items = split_matches(batch(seed, lengths)) if lengths else []
    items = [replace(item, cost=None) if b in without_cost else item for b, item in enumerate(items)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdicts, "BLOCK_MATCHES", block)
        results = list(filter_each(enumerate(items), exact_filter()))
    assert [key for key, _ in results] == list(range(len(items)))
    for (_, result), item in zip(results, items, strict=True):
        assert_same(result, expected_exactly(item))


def test_a_stream_is_read_no_further_than_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verdicts, "BLOCK_MATCHES", 40)
    taken: list[int] = []

    def pairs() -> object:
        for b, item in enumerate(split_matches(batch(0, [15] * 9))):
            taken.append(b)
            yield b, item

    stream = filter_each(pairs(), exact_filter())  # type: ignore[arg-type]
    next(stream)
    assert taken == [0, 1, 2]


def test_summaries_count_every_match_once() -> None:
    matches = batch(1)
    result = expected_exactly(matches)
    summary = FilterSummary().add(5, result).add(2, result)
    assert summary.num_pairs == 7
    assert summary.num_matches == 2 * matches.num_matches
    assert summary.num_kept == 2 * result.inlier.sum() > 0
    assert summary.num_untested == 2 * (result.relation == 0).sum() > 0
    assert summary.num_kept + summary.num_rejected + summary.num_untested == summary.num_matches


@given(seeds, st.integers(0, 30))
def test_spread_and_take_undo_each_other(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random(n) < 0.5
    m = int(mask.sum())
    given_ = Verdicts(rng.random(m) < 0.5, rng.random(m), rng.integers(0, 5, m).astype(np.int8))
    wide = given_.spread(mask)
    assert_same(wide.take(np.flatnonzero(mask)), given_)
    rest = wide.take(np.flatnonzero(~mask))
    assert not rest.inlier.any()
    assert not rest.score.any()
    assert not rest.relation.any()


def test_the_batch_of_the_tests_has_duplicates_and_all_relations() -> None:
    result = expected_exactly(collate_matches([batch(seed) for seed in range(5)]))
    assert set(result.relation.tolist()) == {0, 1, 2, 3, 4}
