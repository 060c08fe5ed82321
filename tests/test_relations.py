from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.configs import Backend
from tensor_stereo.ops import relate
from tensor_stereo.relations import shared_neighbors
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
    size = torch.full((7,), 7)
    relation, inlier = relate(overlap, a0.degree, a1.degree, size, 1, True, backend)
    strict = relate(overlap, a0.degree, a1.degree, size, 1, False, backend)[1]
    for node in range(7):
        sets = [{j for e in edges for i, j in (e, e[::-1]) if i == node} for edges in (edges0, edges1)]
        expected = relation_of_sets(*sets) if all(sets) else "UNTESTED"
        assert Relation(int(relation[node])).name == expected
        assert bool(inlier[node]) == (expected in ("EQUAL", "SUBSET", "SUPERSET"))
        assert bool(strict[node]) == (expected == "EQUAL")


sizes = st.integers(0, 5)


@given(st.lists(st.tuples(sizes, sizes, sizes, sizes)), st.integers(1, 5), st.booleans())
def test_every_back_end_relates_alike(rows: list[tuple[int, ...]], min_group_size: int, accept_subsets: bool) -> None:
    columns = torch.tensor(rows, dtype=torch.int64).reshape(-1, 4).T
    results = [relate(*columns, min_group_size, accept_subsets, backend) for backend in installed_backends()]
    for relation, inlier in results:
        assert torch.equal(relation, results[0][0])
        assert torch.equal(inlier, results[0][1])
        assert not inlier[relation == Relation.UNTESTED].any()
        assert (relation[columns[3] < min_group_size] == Relation.UNTESTED).all()


@pytest.mark.parametrize("backend", installed_backends())
def test_operator_keeps_the_rules_of_torch_and_compiles(backend: Backend) -> None:
    columns = torch.randint(0, 4, (4, 30), generator=torch.Generator().manual_seed(0)).unbind()
    torch.library.opcheck(torch.ops.tensor_stereo.relate.default, (*columns, 2, True, backend))
    compiled = torch.compile(lambda: relate(*columns, 2, True, backend)[1].sum(), fullgraph=True, backend="aot_eager")
    assert int(compiled()) == int(relate(*columns, 2, True, backend)[1].sum())


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="adjacency0 and adjacency1"):
        shared_neighbors(_adjacency(set()), _adjacency(set(), 3))
