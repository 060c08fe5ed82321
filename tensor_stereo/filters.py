"""The classifier: putative matches in, verdicts out."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensor_stereo import ops
from tensor_stereo.batching import from_padded
from tensor_stereo.configs import Backend, Restriction
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.types import Classification, Matches


def classify_matches(
    matches: Matches,
    *,
    restriction: Restriction = "cardinality",
    min_group_size: int = 4,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Classification:
    """Decide for every match of a batch whether its neighbours are the same in both views.

    Args:
        matches: B pairs; with ``group``, each group is triangulated on its own (Restriction 3).
        restriction: ``adjacency`` (Restriction 1): inlier iff both neighbour sets are equal. ``cardinality``
            (Restriction 2): inlier iff one contains the other.
        min_group_size: groups of fewer distinct matches are (almost) complete graphs, which agree whatever happened:
            UNTESTED, never an inlier. 1 is the literal reading of the paper.
        tie_tolerance: as in :func:`tensor_stereo.build_graphs`, in edge lengths.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        One entry per row of ``matches``, on its device. A match is UNTESTED if it repeats a keypoint of a cheaper
        match, if its group is too small, or if it has no neighbour in a view though its group has other matches.
        No gradient.

    Raises:
        ValueError: for NaN or infinite keypoints (naming pair and row), NaN cost or an unknown option.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 3.

    Example:
        >>> import torch, tensor_stereo as ts
        >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0], [5.0, 4.0]])
        >>> right = left - torch.tensor([3.0, 0.0])
        >>> ts.classify_matches(ts.Matches(left, right, torch.tensor([0, 5]))).inlier.all()
        tensor(True)
    """
    graphs = build_match_graphs(matches, tie_tolerance=tie_tolerance, backend=backend)
    return classify_graphs(graphs, restriction=restriction, min_group_size=min_group_size, backend=backend)


def classify_graphs(
    graphs: MatchGraphs,
    *,
    restriction: Restriction = "cardinality",
    min_group_size: int = 4,
    backend: Backend = "auto",
) -> Classification:
    """The set tests of :func:`classify_matches` on graphs that exist already.

    Example:
        >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0]])
        >>> graphs = build_match_graphs(Matches(left, left - 2, torch.tensor([0, 3])))
        >>> classify_graphs(graphs, min_group_size=3).relation
        tensor([1, 1, 1], dtype=torch.int8)
    """
    if min_group_size < 1:
        raise ValueError(f"min_group_size must be at least 1, got {min_group_size}")
    accept_subsets = {"adjacency": False, "cardinality": True}.get(restriction)
    if accept_subsets is None:
        raise ValueError(f"restriction must be 'adjacency' or 'cardinality', got {restriction!r}")
    overlap, degree0, degree1 = shared_neighbors(graphs.adjacency0, graphs.adjacency1, backend=backend)
    relation, inlier = ops.relate(overlap, degree0, degree1, graphs.group_size, min_group_size, accept_subsets, backend)
    return Classification(inlier, relation, overlap, degree0, degree1)


class FilterOutput(NamedTuple):
    """Verdicts in the layout of the input: (B, N) for padded keypoints; False and UNTESTED in the padding."""

    inlier: Tensor
    relation: Tensor


class DelaunayFilter(nn.Module):
    """:func:`classify_matches` for padded keypoints, as a module without parameters.

    Args:
        restriction: as in :func:`classify_matches`.
        min_group_size: as in :func:`classify_matches`.
        tie_tolerance: as in :func:`classify_matches`.
        backend: as in :func:`classify_matches`.

    Example:
        >>> left = torch.rand(2, 50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> DelaunayFilter()(left, right).inlier.all()
        tensor(True)
    """

    def __init__(
        self,
        *,
        restriction: Restriction = "cardinality",
        min_group_size: int = 4,
        tie_tolerance: float = 1e-3,
        backend: Backend = "auto",
    ) -> None:
        super().__init__()
        self.restriction = restriction
        self.min_group_size = min_group_size
        self.tie_tolerance = tie_tolerance
        self.backend = backend

    def forward(
        self,
        keypoints0: Tensor,
        keypoints1: Tensor,
        mask: Tensor | None = None,
        group: Tensor | None = None,
        cost: Tensor | None = None,
    ) -> FilterOutput:
        """Classify padded pairs.

        Args:
            keypoints0: (B, N, 2) px of view 0.
            keypoints1: (B, N, 2) px of view 1; row i of both is one match.
            mask: (B, N) bool, True for real matches; None means all.
            group: (B, N) integer object groups.
            cost: (B, N), lower is better.

        Returns:
            ``inlier`` (B, N) bool and ``relation`` (B, N) int8. No gradient.

        Raises:
            ValueError: if shapes disagree, or as :func:`classify_matches`.
        """
        if keypoints0.ndim != 3 or keypoints0.shape[2] != 2:
            raise ValueError(f"keypoints0 must have shape (B, N, 2), got {tuple(keypoints0.shape)}")
        for name, value, shape in (
            ("keypoints1", keypoints1, keypoints0.shape),
            ("mask", mask, keypoints0.shape[:2]),
            ("group", group, keypoints0.shape[:2]),
            ("cost", cost, keypoints0.shape[:2]),
        ):
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(value.shape)}")
        rows0, ptr = from_padded(keypoints0, mask)
        rows1, cost, group = (None if v is None else from_padded(v, mask)[0] for v in (keypoints1, cost, group))
        result = classify_matches(
            Matches(rows0, rows1, ptr, cost, group),  # type: ignore[arg-type]
            restriction=self.restriction,
            min_group_size=self.min_group_size,
            tie_tolerance=self.tie_tolerance,
            backend=self.backend,
        )
        if mask is None:
            shape = keypoints0.shape[:2]
            return FilterOutput(result.inlier.reshape(shape), result.relation.reshape(shape))
        inlier = torch.zeros_like(mask).masked_scatter(mask, result.inlier)
        relation = torch.zeros_like(mask, dtype=torch.int8).masked_scatter(mask, result.relation)
        return FilterOutput(inlier, relation)
