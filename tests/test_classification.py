from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.batching import collate_matches, select_matches, split_matches, to_padded
from tensor_stereo.classification import apply_score, classify_matches
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.modules import DelaunayFilter
from tensor_stereo.types import Classification, Matches, Relation
from tests.oracles import neighbor_sets, relation_of_sets

KINDS = ("integer", "subpixel", "grid")


def random_pair(kind: str, seed: int, n: int, wrong: float = 0.3) -> Matches:
    """One pair with a smooth disparity and a share of wrong matches; no duplicate keypoints."""
    rng = np.random.default_rng([seed, n])
    if kind == "subpixel":
        left = rng.random((n, 2)) * [640, 480]
    else:
        step = 8 if kind == "grid" else 1
        cells = rng.choice((640 // step) * (480 // step), size=n, replace=False)
        left = np.stack([cells % (640 // step), cells // (640 // step)], 1) * float(step)
    disparity = 20 + 30 * np.sin(left[:, 0] / 200) * np.cos(left[:, 1] / 150)
    right = left - np.stack([disparity if kind == "subpixel" else np.round(disparity), np.zeros(n)], 1)
    bad = rng.random(n) < wrong
    right[bad] = left[rng.permutation(n)[bad]] + 0.25
    _, first = np.unique(right, axis=0, return_index=True)
    first.sort()
    ptr = torch.tensor([0, len(first)])
    cost = torch.from_numpy(rng.random(len(first)))
    return Matches(torch.from_numpy(left[first]), torch.from_numpy(right[first]), ptr, cost)


def move(matches: Matches, function: object) -> Matches:
    moved = (function(points) for points in (matches.keypoints0, matches.keypoints1))  # type: ignore[operator]
    return Matches(*moved, matches.ptr, matches.cost, matches.group)


def assert_equal(a: Classification, b: Classification) -> None:
    for name in ("inlier", "relation", "overlap", "degree0", "degree1"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 10**6)
sizes = st.integers(0, 80)


@given(kinds, seeds, sizes, st.sampled_from([1, 4]))
def test_verdicts_are_those_of_python_sets_and_of_dense_matrices(kind: str, seed: int, n: int, least: int) -> None:
    matches = random_pair(kind, seed, n)
    graphs = build_match_graphs(matches)
    result = classify_matches(matches, min_group_size=least)
    sets0, sets1 = neighbor_sets(graphs.adjacency0), neighbor_sets(graphs.adjacency1)
    dense = (graphs.adjacency0.to_dense(0) & graphs.adjacency1.to_dense(0)).sum(-1)
    assert torch.equal(result.overlap, dense)
    for row, (n0, n1) in enumerate(zip(sets0, sets1, strict=True)):
        evidence = matches.num_matches >= least and (bool(n0 and n1) or matches.num_matches == 1)
        expected = relation_of_sets(n0, n1) if evidence else "UNTESTED"
        assert Relation(int(result.relation[row])).name == expected
        assert bool(result.inlier[row]) == (expected in ("EQUAL", "SUBSET", "SUPERSET"))


@given(kinds, seeds, sizes)
def test_order_of_the_matches_does_not_matter(kind: str, seed: int, n: int) -> None:
    matches = random_pair(kind, seed, n)
    order = torch.randperm(matches.num_matches, generator=torch.Generator().manual_seed(seed))
    shuffled = Matches(matches.keypoints0[order], matches.keypoints1[order], matches.ptr, matches.cost[order])  # type: ignore[index]
    assert torch.equal(classify_matches(matches).relation[order], classify_matches(shuffled).relation)


@given(kinds, seeds, sizes)
def test_exchanging_the_views_exchanges_subset_and_superset(kind: str, seed: int, n: int) -> None:
    matches = random_pair(kind, seed, n)
    forth, back = classify_matches(matches), classify_matches(matches.swap())
    assert torch.equal(forth.inlier, back.inlier)
    exchange = torch.tensor([0, 1, 3, 2, 4], dtype=torch.int8)
    assert torch.equal(exchange[forth.relation.long()], back.relation)


@given(kinds, seeds, sizes, st.integers(-2000, 2000), st.integers(-2000, 2000))
def test_exact_translation_changes_no_verdict(kind: str, seed: int, n: int, dx: int, dy: int) -> None:
    matches = move(random_pair(kind, seed, n), lambda p: (p * 1024).round() / 1024)
    moved = move(matches, lambda p: p + torch.tensor([dx, dy], dtype=p.dtype))
    assert_equal(classify_matches(matches), classify_matches(moved))


@given(kinds, seeds, sizes)
def test_rounding_changes_no_verdict(kind: str, seed: int, n: int) -> None:
    matches = random_pair(kind, seed, n)
    expected = classify_matches(matches)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
    for function in (lambda p: p / 3, lambda p: p @ turn, lambda p: p.float().double(), lambda p: p.float() / 3):
        assert_equal(expected, classify_matches(move(matches, function)))


def test_batch_equals_loop_with_and_without_groups() -> None:
    pairs = [
        random_pair(kind, seed, n) for kind, (seed, n) in zip(KINDS * 2, enumerate((90, 0, 3, 1, 40, 2)), strict=True)
    ]
    for num_groups in (1, 5):
        grouped = [
            Matches(p.keypoints0, p.keypoints1, p.ptr, p.cost, torch.arange(p.num_matches) % num_groups) for p in pairs
        ]
        batch = classify_matches(collate_matches(grouped))
        loop = [classify_matches(pair) for pair in grouped]
        for name in ("inlier", "relation", "overlap", "degree0", "degree1"):
            assert torch.equal(getattr(batch, name), torch.cat([getattr(one, name) for one in loop]))


def test_groups_are_pairs_of_their_own() -> None:
    pair = random_pair("integer", 3, 90)
    group = torch.arange(pair.num_matches) % 4
    whole = classify_matches(Matches(pair.keypoints0, pair.keypoints1, pair.ptr, pair.cost, group))
    for label in range(4):
        rows = group == label
        assert torch.equal(whole.relation[rows], classify_matches(select_matches(pair, rows)).relation)


def test_duplicates_are_untested_and_do_not_disturb_the_others() -> None:
    pair = random_pair("subpixel", 5, 60)
    doubled = collate_matches([pair, pair])
    doubled = Matches(doubled.keypoints0, doubled.keypoints1, torch.tensor([0, 2 * pair.num_matches]))
    result = classify_matches(doubled)
    assert torch.equal(result.relation[: pair.num_matches], classify_matches(pair).relation)
    assert (result.relation[pair.num_matches :] == Relation.UNTESTED).all()
    assert not result.inlier[pair.num_matches :].any()


@pytest.mark.parametrize("n", range(6))
def test_small_groups_are_untested_unless_read_literally(n: int) -> None:
    pair = random_pair("subpixel", 8, n, wrong=0)
    relation = Relation.UNTESTED if n < 4 else Relation.EQUAL
    assert classify_matches(pair).relation.tolist() == [relation] * n
    assert classify_matches(pair, min_group_size=1).relation.tolist() == [Relation.EQUAL] * n


def test_collinear_matches_are_compared_as_paths() -> None:
    left = torch.stack([torch.arange(6.0), torch.zeros(6)], 1)
    right = left[[0, 1, 2, 3, 5, 4]] + 10  # the last two change places
    result = classify_matches(Matches(left, right, torch.tensor([0, 6])))
    assert result.degree0.tolist() == [1, 2, 2, 2, 2, 1]
    assert [Relation(r).name for r in result.relation.tolist()] == [
        "EQUAL", "EQUAL", "EQUAL", "CONFLICT", "SUPERSET", "SUBSET",
    ]  # fmt: skip


def test_one_wrong_match_touches_only_its_neighbours() -> None:
    left = random_pair("grid", 2, 300, wrong=0).keypoints0
    right = left.clone()
    right[0] += torch.tensor([200.0, 100.5])
    result = classify_matches(Matches(left, right, torch.tensor([0, len(left)])))
    graphs = build_match_graphs(Matches(left, right, torch.tensor([0, len(left)])))
    clean = build_match_graphs(Matches(left[1:], left[1:], torch.tensor([0, len(left) - 1])))
    assert not result.inlier[0]
    sets0, sets1 = neighbor_sets(graphs.adjacency0), neighbor_sets(graphs.adjacency1)
    untouched = [i for i in range(1, len(left)) if not ({0} & (sets0[i] | sets1[i]))]
    kept = {i for i in untouched if result.relation[i] == Relation.EQUAL}
    same = {i for i in untouched if sets0[i] == {j + 1 for j in clean.adjacency0.neighbors(i - 1).tolist()} == sets1[i]}
    assert same <= kept


def test_module_equals_function_for_any_padding() -> None:
    pairs = [random_pair("integer", seed, n) for seed, n in enumerate((50, 7, 0, 30))]
    batch = collate_matches(pairs)
    for fill, extra in itertools.product((0.0, float("nan")), (0, 9)):
        num_rows = max(p.num_matches for p in pairs) + extra
        (k0, mask), (k1, _), (cost, _) = (
            to_padded(v, batch.ptr, num_rows=num_rows, fill=fill)
            for v in (batch.keypoints0, batch.keypoints1, batch.cost)  # type: ignore[arg-type]
        )
        output = DelaunayFilter(verdict="adjacency")(k0, k1, mask, cost=cost)
        expected = classify_matches(batch, restriction="adjacency")
        assert torch.equal(output.inlier[mask], expected.inlier)
        assert torch.equal(output.relation[mask], expected.relation)
        assert not output.inlier[~mask].any()


def test_module_names_a_bad_argument() -> None:
    good = torch.rand(2, 5, 2)
    module = DelaunayFilter()
    for name, arguments in {
        "keypoints0": (good[..., :1], good[..., :1]),
        "keypoints1": (good, good[:, :4]),
        "mask": (good, good, torch.ones(2, 4, dtype=torch.bool)),
        "group": (good, good, None, torch.zeros(2, 4, dtype=torch.int64)),
        "cost": (good, good, None, None, torch.zeros(3, 5)),
    }.items():
        with pytest.raises(ValueError, match=name):
            module(*arguments)
    with pytest.raises(TypeError, match="mask"):
        module(good, good, torch.ones(2, 5))


def test_min_group_size_is_checked() -> None:
    with pytest.raises(ValueError, match="min_group_size"):
        classify_matches(random_pair("integer", 0, 5), min_group_size=0)
    with pytest.raises(ValueError, match="restriction"):
        classify_matches(random_pair("integer", 0, 5), restriction="cardinal")  # type: ignore[arg-type]


def test_split_matches_is_the_inverse_of_collate_matches() -> None:
    pairs = [random_pair("integer", seed, n) for seed, n in enumerate((5, 0, 3))]
    for one, back in zip(pairs, split_matches(collate_matches(pairs)), strict=True):
        assert torch.equal(one.keypoints1, back.keypoints1)
        assert torch.equal(one.ptr, back.ptr)


def test_the_default_threshold_is_one_half_and_included() -> None:
    matches = random_pair("float", 1, 40)
    verdict = classify_matches(matches)
    tested = verdict.relation != Relation.UNTESTED
    score = torch.full((40,), 0.5)
    score[::3], score[1::3] = 0.4999, 0.5001
    decided, shown = apply_score(verdict, score, matches.ptr)
    assert torch.equal(decided.inlier, tested & (torch.arange(40) % 3 > 0))
    assert torch.equal(shown, torch.where(tested, score, 0))
    for restriction in ("adjacency", "cardinality"):
        assert torch.equal(verdict.inlier_of(restriction), classify_matches(matches, restriction=restriction).inlier)
        kept, _ = apply_score(verdict, score, matches.ptr, FilterConfig(verdict="cardinality", score="learned"))
        assert torch.equal(kept.inlier, verdict.inlier)
