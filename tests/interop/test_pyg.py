from __future__ import annotations

import networkx as nx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import Matches, build_graphs
from tensor_stereo.batching import collate_matches, lengths_to_ptr, split_matches
from tensor_stereo.interop.pyg import from_edge_index, from_pyg, to_edge_index, to_pyg

lengths = st.lists(st.integers(0, 12), max_size=5)


def random_matches(counts: list[int]) -> Matches:
    generator = torch.Generator().manual_seed(len(counts))
    ptr = lengths_to_ptr(torch.tensor(counts, dtype=torch.int64))
    num = int(ptr[-1])
    keypoints = torch.rand(num, 2, 2, generator=generator) * 100
    cost, group = torch.rand(num, generator=generator), torch.randint(3, (num,), generator=generator)
    return Matches(keypoints[0:, 0], keypoints[:, 1], ptr, cost, group)


@given(lengths)
def test_matches_come_back_from_a_batch_vector(counts: list[int]) -> None:
    matches = random_matches(counts)
    attributes = to_pyg(matches)
    assert attributes["batch"].tolist() == [b for b, count in enumerate(counts) for _ in range(count)]
    ptr = attributes.pop("ptr")
    back = from_pyg(**attributes, num_pairs=len(ptr) - 1)  # type: ignore[arg-type]
    for name in ("keypoints0", "keypoints1", "ptr", "cost", "group"):
        assert torch.equal(getattr(back, name), getattr(matches, name)), name


def test_no_batch_vector_is_one_pair_and_absent_columns_stay_absent() -> None:
    matches = from_pyg(torch.zeros(0, 2), torch.zeros(0, 2))
    assert matches.ptr.tolist() == [0, 0]
    assert to_pyg(matches).keys() == {"keypoints0", "keypoints1", "batch", "ptr"}
    with pytest.raises(ValueError, match="batch must be sorted"):
        from_pyg(torch.zeros(2, 2), torch.zeros(2, 2), torch.tensor([1, 0]))
    with pytest.raises(ValueError, match="batch"):
        from_pyg(torch.zeros(2, 2), torch.zeros(2, 2), torch.tensor([1]))


@given(lengths, st.integers(0, 100))
def test_edge_index_is_the_graph_and_comes_back_in_any_order(counts: list[int], seed: int) -> None:
    matches = random_matches(counts)
    adjacency = build_graphs(matches.keypoints0, matches.ptr)
    edges = to_edge_index(adjacency)
    assert edges.shape == (2, len(adjacency.col_indices))
    graph = nx.Graph()
    graph.add_nodes_from(range(matches.num_matches))
    graph.add_edges_from(edges.t().tolist())
    assert [sorted(graph[k]) for k in graph] == [adjacency.neighbors(k).tolist() for k in graph]
    order = torch.randperm(edges.shape[1], generator=torch.Generator().manual_seed(seed))
    shuffled = torch.cat([edges[:, order], edges[:, :1]], 1)  # and one edge twice
    back = from_edge_index(shuffled, adjacency.ptr)
    assert torch.equal(back.crow_indices, adjacency.crow_indices)
    assert torch.equal(back.col_indices, adjacency.col_indices)


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ([[0], [1]], "both directions"),
        ([[0], [0]], "itself"),
        ([[1, 2], [2, 1]], "two graphs"),
        ([[0, 4], [4, 0]], "nodes 0..3"),
    ],
)
def test_edges_that_no_adjacency_can_hold_are_refused(edges: list[list[int]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_edge_index(torch.tensor(edges), torch.tensor([0, 2, 4]))


def test_bad_edge_index_is_named() -> None:
    with pytest.raises(TypeError, match="edge_index must be int64"):
        from_edge_index(torch.zeros(2, 0), torch.tensor([0]))
    with pytest.raises(ValueError, match="edge_index must have shape"):
        from_edge_index(torch.zeros(0, 2, dtype=torch.int64), torch.tensor([0]))


def test_torch_geometric_batches_matches_as_collate_matches_does() -> None:
    data = pytest.importorskip("torch_geometric.data")
    parts = split_matches(random_matches([3, 4, 5]))
    graphs = []
    for part in parts:
        attributes = to_pyg(part)
        edges = to_edge_index(build_graphs(part.keypoints0, part.ptr))
        fields = {name: attributes[name] for name in ("keypoints0", "keypoints1", "cost")}
        graphs.append(data.Data(edge_index=edges, num_nodes=part.num_matches, **fields))
    batch = data.Batch.from_data_list(graphs)
    joined = collate_matches(parts)
    assert torch.equal(batch.batch, to_pyg(joined)["batch"])
    assert torch.equal(batch.ptr, joined.ptr)
    whole = build_graphs(joined.keypoints0, joined.ptr)
    back = from_edge_index(batch.edge_index, batch.ptr)
    assert torch.equal(back.col_indices, whole.col_indices)
