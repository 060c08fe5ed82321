"""Consensus: a score without learnt weights, from how far the neighbours of a match agree with its displacement.

Every match fits a plane through the displacements of its believed neighbours; every neighbour predicts by its plane
what the match should be, and the share of believed neighbours that are right about it is the support of the match.
Support, and what the match itself says (its row offset, its cost), give the belief of the next round, so that a wrong
match loses its vote instead of condemning its neighbours. Neighbours that disagree, as across a depth edge, cost no
more than their share: of several surfaces one is enough.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.ops.registration import refuse_tangent
from tensor_stereo.scores.alignment.form import Alignment, alignment_kind, epipolar_frames
from tensor_stereo.scores.calibration import calibrate_consensus
from tensor_stereo.scores.tolerance import probability_within
from tensor_stereo.types import Matches


def consensus_score(
    matches: Matches, graphs: MatchGraphs, config: FilterConfig | None = None, alignment: Alignment | None = None
) -> Tensor:
    """The calibrated probability that each match is right, by what its neighbours in both views believe.

    Args:
        matches: B pairs, as for :func:`consensus_belief`.
        graphs: The graphs of both views, as :func:`tensor_stereo.graphs.build_match_graphs` gives them.
        config: The settings ``consensus``, ``max_error_px`` and ``backend`` are read; None means the defaults.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.

    Returns:
        (M,) probability of an error of at most ``max_error_px``, of :func:`consensus_probabilities`, in the dtype of
        the keypoints. Gradients flow to both keypoints and the cost, but not where a belief lies below 1e-4 or above
        1 - 1e-4.

    Raises:
        ValueError, NotImplementedError: as :func:`consensus_belief`.

    Example:
        >>> import torch
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> right[0] += 20
        >>> matches = Matches(left, right, torch.tensor([0, 50]))
        >>> probability = consensus_score(matches, build_match_graphs(matches))
        >>> probability[0] < 0.1, probability[1:].min() > 0.9
        (tensor(True), tensor(True))
    """
    config = config or FilterConfig()
    return probability_within(consensus_probabilities(matches, graphs, config, alignment), config.max_error_px)


def consensus_probabilities(
    matches: Matches, graphs: MatchGraphs, config: FilterConfig | None = None, alignment: Alignment | None = None
) -> Tensor:
    """The calibrated probabilities that each match is right within each tolerance.

    They are :func:`consensus_belief` through :func:`tensor_stereo.scores.calibration.calibrate_consensus`.

    Args:
        matches: B pairs, as for :func:`consensus_belief`.
        graphs: The graphs of both views, as :func:`tensor_stereo.graphs.build_match_graphs` gives them.
        config: The settings ``consensus`` and ``backend`` are read; None means the defaults.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.

    Returns:
        (M, 5) in the dtype of the keypoints, for :data:`tensor_stereo.scores.tolerance.TOLERANCES_PX`; no row falls.
        Gradients as those of :func:`consensus_score`.

    Raises:
        ValueError, NotImplementedError: as :func:`consensus_belief`.

    >>> import torch
    >>> from tensor_stereo.graphs import build_match_graphs
    >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
    >>> matches = Matches(left, left - torch.tensor([5.0, 0.0]), torch.tensor([0, 50]))
    >>> consensus_probabilities(matches, build_match_graphs(matches)).shape
    torch.Size([50, 5])
    """
    config = config or FilterConfig()
    belief = _believe(matches, graphs, config, alignment)
    kind = None if alignment is None else alignment_kind(matches, alignment)
    return calibrate_consensus(belief, kind).to(matches.keypoints0.dtype)


def consensus_belief(
    matches: Matches, graphs: MatchGraphs, config: FilterConfig | None = None, alignment: Alignment | None = None
) -> Tensor:
    """How much the neighbours of each match believe in it, before calibration.

    Args:
        matches: B pairs, coordinates in px: what is below 1 px is near. ``cost``, if given, is evidence: it is compared
            with the other costs of its pair, and left out in pairs that have infinite ones.
        graphs: The graphs of both views, as :func:`tensor_stereo.graphs.build_match_graphs` gives them.
        config: The settings ``consensus`` and ``backend`` are read; None means the defaults. Back ends may differ in
            the last digits.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.

    Returns:
        (M,) in [0, 1], higher is more likely correct; 0 without neighbours; in the dtype of the keypoints. Gradients
        flow to both keypoints and the cost, and are finite; graphs, alignment and the choice of the tolerance are
        constant. There is no forward mode.

    Raises:
        ValueError: for graphs over another number of matches.
        NotImplementedError: for tensors that carry a tangent.

    Example:
        >>> import torch
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> right[0] += 20
        >>> matches = Matches(left, right, torch.tensor([0, 50]))
        >>> belief = consensus_belief(matches, build_match_graphs(matches))
        >>> belief[0] < 0.01, belief[1:].min() > 0.5
        (tensor(True), tensor(True))
    """
    return _believe(matches, graphs, config or FilterConfig(), alignment).to(matches.keypoints0.dtype)


def _believe(matches: Matches, graphs: MatchGraphs, config: FilterConfig, alignment: Alignment | None) -> Tensor:
    """(M,) float64."""
    for name in ("keypoints0", "keypoints1", "cost"):
        values: Tensor | None = getattr(matches, name)
        if values is not None:
            refuse_tangent(name, values, "consensus")
    check_match_graphs(matches, graphs)
    settings = config.consensus
    right, row_offset, found1 = _see_view1(matches, alignment)
    belief: Tensor = ops.consensus_belief(
        matches.keypoints0,
        right,
        matches.ptr,
        matches.cost,
        row_offset,
        found1,
        *graphs.patterns,
        settings.tolerance_px,
        settings.whole_tolerance_px,
        settings.row_tolerance_px,
        settings.whole_row_tolerance_px,
        settings.slope,
        settings.reach,
        settings.doubt,
        settings.cost_weight,
        settings.num_rounds,
        config.backend,
    )
    return belief


def _see_view1(matches: Matches, alignment: Alignment | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Keypoints of view 1 as displacements want them, offsets from the rows, and keypoints of view 1 as found."""
    right = matches.keypoints1
    row_offset = matches.keypoints0[:, 1].double() - right[:, 1].double()
    if alignment is None:
        return right, row_offset, None
    row_offset = row_offset + alignment.row_shift(matches)
    if not torch.compiler.is_compiling() and bool(alignment.rectified.all()):
        return right, row_offset, None
    batch = ptr_to_batch(matches.ptr)
    frames = epipolar_frames(matches, alignment)
    is_rectified, has_rows = (values.index_select(0, batch) for values in (alignment.rectified, alignment.has_rows))
    off = torch.where(has_rows, -frames.moved[:, 1], 0)
    row_offset = torch.where(is_rectified, row_offset, off)
    is_rectified = is_rectified[:, None]
    # Keypoints that were found on whole pixels may have been moved since in view 1; of any two views, view 0 tells.
    found = torch.where(is_rectified, right, matches.keypoints0)
    return torch.where(is_rectified, right.double(), frames.partners), row_offset, found
