from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.configs import Backend
from tensor_stereo.relations import is_inlier, relate, shared_neighbors
from tensor_stereo.types import Adjacency, Relation
from tests.oracles import installed_backends, relation_of_sets

edge_lists = st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)).filter(lambda e: e[0] < e[1]))


def _adjacency(edges: set[tuple[int, int]], num_nodes: int = 7) -> Adjacency:
    dense = torch.zeros(num_nodes, num_nodes, dtype=torch.bool)
    for i, j in edges:
        dense[i, j] = dense[j, i] = True
    return Adjacency(lengths_to_ptr(dense.sum(1)), dense.nonzero()[:, 1], torch.tensor([0, num_nodes]))


@given(edge_lists, edge_lists, st.sampled_from(installed_backends()))
def test_relations_are_those_of_sets_and_of_matrices(edges0: set, edges1: set, backend: Backend) -> None:
    a0, a1 = _adjacency(edges0), _adjacency(edges1)
    overlap = shared_neighbors(a0, a1, backend=backend).overlap
    dense0, dense1 = a0.to_dense(0), a1.to_dense(0)
    assert torch.equal(overlap, (dense0 & dense1).sum(1))
    product = a0.to_sparse_csr(torch.int64) * a1.to_sparse_csr(torch.int64)
    assert torch.equal(overlap, product.to_dense().sum(1))
    tested = torch.ones(7, dtype=torch.bool)
    relation = relate(overlap, a0.degree, a1.degree, tested)
    for node in range(7):
        sets = [{j for e in edges for i, j in (e, e[::-1]) if i == node} for edges in (edges0, edges1)]
        assert Relation(int(relation[node])).name == relation_of_sets(*sets)


@given(edge_lists, edge_lists)
def test_exchanging_the_views_exchanges_subset_and_superset(edges0: set, edges1: set) -> None:
    a0, a1 = _adjacency(edges0), _adjacency(edges1)
    tested = torch.ones(7, dtype=torch.bool)
    forth = relate(shared_neighbors(a0, a1).overlap, a0.degree, a1.degree, tested)
    back = relate(shared_neighbors(a1, a0).overlap, a1.degree, a0.degree, tested)
    exchanged = {Relation.SUBSET: Relation.SUPERSET, Relation.SUPERSET: Relation.SUBSET}
    assert [exchanged.get(Relation(r), Relation(r)) for r in forth.tolist()] == back.tolist()


def test_untested_is_never_an_inlier() -> None:
    one, never = torch.ones(1, dtype=torch.int64), torch.zeros(1, dtype=torch.bool)
    relation = relate(one, one, one, never)
    assert relation.tolist() == [Relation.UNTESTED]
    assert not is_inlier(relation, "adjacency").any()
    assert not is_inlier(relation, "cardinality").any()


def test_adjacency_verdict_implies_cardinality_verdict() -> None:
    every = torch.arange(5)
    assert not (is_inlier(every, "adjacency") & ~is_inlier(every, "cardinality")).any()
    assert is_inlier(every, "adjacency").tolist() == [False, True, False, False, False]


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="adjacency0 and adjacency1"):
        shared_neighbors(_adjacency(set()), _adjacency(set(), 3))
    with pytest.raises(ValueError, match="restriction"):
        is_inlier(torch.arange(5), "cardinal")  # type: ignore[arg-type]
