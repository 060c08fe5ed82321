"""Consensus: a score without learnt weights, from how far the neighbours of a match agree with its displacement.

Every match fits a plane through the displacements of its believed neighbours; every neighbour predicts by its plane
what the match should be, and the share of believed neighbours that are right about it is the support of the match.
Support, and what the match itself says (its row offset, its cost), give the belief of the next round, so that a wrong
match loses its vote instead of condemning its neighbours. Neighbours that disagree, as across a depth edge, cost no
more than their share: of several surfaces one is enough.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.autograd import forward_ad

from tensor_stereo import ops
from tensor_stereo.configs import Backend, ConsensusConfig
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.types import Matches

_MAX_ROUNDS = 1000


def consensus_score(
    matches: Matches, graphs: MatchGraphs, config: ConsensusConfig | None = None, *, backend: Backend = "auto"
) -> Tensor:
    """How likely every match is right, by what its neighbours in both views believe.

    Args:
        matches: B pairs, coordinates in px: what is below 1 px is near. ``cost``, if given, is evidence: it is compared
            with the other costs of its pair, and left out in pairs that have infinite ones.
        graphs: of both views, as :func:`tensor_stereo.graphs.build_match_graphs` gives them.
        config: None means the defaults, for rectified pairs.
        backend: as in :func:`tensor_stereo.build_graphs`, but back ends may differ in the last digits.

    Returns:
        (M,) in [0, 1], higher is more likely correct; 0 without neighbours; in the dtype of the keypoints. Gradients
        flow to both keypoints and the cost, and are finite; the graphs and the choice of the tolerance are constant.
        There is no forward mode.

    Raises:
        ValueError: for graphs over another number of matches, or settings that do not fit.
        NotImplementedError: for tensors that carry a tangent.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> right[0] += 20
        >>> matches = Matches(left, right, torch.tensor([0, 50]))
        >>> score = consensus_score(matches, build_match_graphs(matches))
        >>> score[0] < 0.01, score[1:].min() > 0.5
        (tensor(True), tensor(True))
    """
    config = config or ConsensusConfig()
    _check_tangents(matches)
    check_match_graphs(matches, graphs)
    check_consensus(config)
    belief: Tensor = ops.consensus_belief(
        matches.keypoints0,
        matches.keypoints1,
        matches.ptr,
        matches.cost,
        graphs.adjacency0.crow_indices,
        graphs.adjacency0.col_indices,
        graphs.adjacency1.crow_indices,
        graphs.adjacency1.col_indices,
        config.tolerance_px,
        config.whole_tolerance_px,
        config.row_tolerance_px,
        config.whole_row_tolerance_px,
        config.slope,
        config.reach,
        config.doubt,
        config.cost_weight,
        config.num_rounds,
        backend,
    )
    return belief.to(matches.keypoints0.dtype)


def _check_tangents(matches: Matches) -> None:
    for name in ("keypoints0", "keypoints1", "cost"):
        values: Tensor | None = getattr(matches, name)
        if values is None or torch.compiler.is_compiling():
            continue
        if forward_ad.unpack_dual(values).tangent is not None:  # type: ignore[no-untyped-call]
            raise NotImplementedError(f"{name} carries a tangent, but the consensus score has no forward mode")


def check_consensus(config: ConsensusConfig) -> None:
    """Raise unless the settings are in range.

    >>> check_consensus(ConsensusConfig())
    """
    for name, value in vars(config).items():
        if name == "num_rounds":
            if not (isinstance(value, int) and 1 <= value <= _MAX_ROUNDS):
                raise ValueError(
                    f"ConsensusConfig.num_rounds must be an integer from 1 to {_MAX_ROUNDS}, got {value!r}"
                )
        elif name == "row_tolerance_px" and value is None:
            continue
        elif not isinstance(value, int | float) or not (0 < value < math.inf or (value == 0 and name == "cost_weight")):
            least = "at least 0" if name == "cost_weight" else "positive"
            raise ValueError(f"ConsensusConfig.{name} must be {least} and finite, got {value!r}")
