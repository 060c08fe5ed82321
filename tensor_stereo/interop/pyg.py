"""PyTorch Geometric: ``batch`` vectors for matches, ``edge_index`` for graphs. All are plain tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.batching import batch_to_ptr, lengths_to_ptr, ptr_to_batch
from tensor_stereo.types import Adjacency, Matches, check_ptr, check_vector


def from_pyg(
    keypoints0: Tensor,
    keypoints1: Tensor,
    batch: Tensor | None = None,
    *,
    num_pairs: int | None = None,
    cost: Tensor | None = None,
    group: Tensor | None = None,
) -> Matches:
    """Matches whose pairs a ``batch`` vector names.

    Args:
        keypoints0: (M, 2) float32 or float64, (x, y) in px of view 0.
        keypoints1: (M, 2) the partners in view 1.
        batch: (M,) int64 pair of each match, sorted; None is one pair.
        num_pairs: B, PyG's ``batch_size``; needed if the last pairs are empty.
        cost: (M,) or None; lower is better.
        group: (M,) integer or None.

    Returns:
        Matches of B pairs, the rows in place. Gradients flow.

    Raises:
        ValueError: if shapes disagree, or ``batch`` is not sorted or names a pair outside ``num_pairs``.

    Example:
        >>> from_pyg(torch.zeros(3, 2), torch.ones(3, 2), torch.tensor([0, 0, 2]), num_pairs=4).ptr
        tensor([0, 2, 2, 3, 3])
    """
    if batch is None:
        batch = torch.zeros(len(keypoints0), dtype=torch.int64, device=keypoints0.device)
        num_pairs = 1 if num_pairs is None else num_pairs
    check_vector("batch", batch, len(keypoints0))
    return Matches(keypoints0, keypoints1, batch_to_ptr(batch, num_pairs), cost, group)


def to_pyg(matches: Matches) -> dict[str, Tensor]:
    """Matches as attributes of a graph: ``torch_geometric.data.Data(**to_pyg(matches))``.

    Returns:
        ``keypoints0``, ``keypoints1`` (M, 2), ``batch`` (M,) and ``ptr`` (B + 1,) int64, and ``cost`` and ``group``
        (M,) if there are such. Gradients flow.

    Example:
        >>> to_pyg(Matches(torch.zeros(3, 2), torch.ones(3, 2), torch.tensor([0, 2, 3])))["batch"]
        tensor([0, 0, 1])
    """
    optional = {"cost": matches.cost, "group": matches.group}
    return {
        "keypoints0": matches.keypoints0,
        "keypoints1": matches.keypoints1,
        "batch": ptr_to_batch(matches.ptr),
        "ptr": matches.ptr,
        **{name: values for name, values in optional.items() if values is not None},
    }


def to_edge_index(adjacency: Adjacency) -> Tensor:
    """Edges of the whole batch, in both directions, nodes numbered through it.

    Returns:
        (2, E) int64, sorted by first row, then second. No gradient.

    Example:
        >>> path = Adjacency(torch.tensor([0, 1, 3, 4]), torch.tensor([1, 0, 2, 1]), torch.tensor([0, 3]))
        >>> to_edge_index(path)
        tensor([[0, 1, 1, 2],
                [1, 0, 2, 1]])
    """
    return torch.stack([adjacency.row_indices, adjacency.col_indices])


def from_edge_index(edge_index: Tensor, ptr: Tensor) -> Adjacency:
    """The adjacency of an undirected ``edge_index``; the inverse of :func:`to_edge_index`.

    Args:
        edge_index: (2, E) int64 in any order, each edge in both directions; repeated edges count once.
        ptr: (B + 1,) int64 offsets of the graphs.

    Returns:
        One block per graph. No gradient.

    Raises:
        ValueError: if an edge leaves its graph, joins a node to itself, or lacks its reverse.
        TypeError: if ``edge_index`` is not int64.

    Example:
        >>> from_edge_index(torch.tensor([[1, 0], [0, 1]]), torch.tensor([0, 2])).crow_indices
        tensor([0, 1, 2])
    """
    if edge_index.ndim != 2 or len(edge_index) != 2:
        raise ValueError(f"edge_index must have shape (2, E), got {tuple(edge_index.shape)}")
    if edge_index.dtype != torch.int64:
        raise TypeError(f"edge_index must be int64, got {edge_index.dtype}")
    num_nodes = int(ptr[-1]) if len(ptr) else 0
    check_ptr("ptr", ptr, num_nodes)
    if bool(((edge_index < 0) | (edge_index >= num_nodes)).any()):
        raise ValueError(f"edge_index must name nodes 0..{num_nodes - 1}, got others")
    if bool((edge_index[0] == edge_index[1]).any()):
        raise ValueError("edge_index must not join a node to itself; remove self-loops first")
    graph = ptr_to_batch(ptr)
    if bool((graph[edge_index[0]] != graph[edge_index[1]]).any()):
        raise ValueError("edge_index must not join nodes of two graphs of ptr")
    keys, reversed_keys = ((a * num_nodes + b).unique() for a, b in (edge_index, edge_index.flip(0)))
    if not torch.equal(keys, reversed_keys):
        raise ValueError("edge_index must hold each edge in both directions; apply to_undirected first")
    rows, cols = keys // max(num_nodes, 1), keys % max(num_nodes, 1)
    return Adjacency(lengths_to_ptr(torch.bincount(rows, minlength=num_nodes)), cols, ptr)
