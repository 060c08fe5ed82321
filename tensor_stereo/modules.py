"""The classifier as a module: padded keypoints or ragged matches in, verdicts and scores out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from tensor_stereo.batching import from_padded
from tensor_stereo.configs import SCORES, Backend, ConsensusConfig, Restriction, Score, TemperatureUnit
from tensor_stereo.filters import FilterOutput, check_verdict, classify_graphs
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.ops.segments import check_options
from tensor_stereo.scores.consensus import check_consensus, consensus_score
from tensor_stereo.scores.evidence import ImageEvidence
from tensor_stereo.scores.learned import score_learned
from tensor_stereo.soft import (
    COLDEST,
    HOTTEST,
    build_soft_graphs,
    check_temperature,
    count_soft_neighbors,
    soft_jaccard,
)
from tensor_stereo.types import Matches, Relation, check_unit

UNTESTED = int(Relation.UNTESTED)  # a compiler takes a tensor for unequal to any member of an enumeration


class DelaunayFilter(nn.Module):
    """:func:`tensor_stereo.classify_matches` with a score, for training loops.

    Args:
        restriction: of the verdict, as in :func:`tensor_stereo.classify_matches`.
        score: ``consensus``, how far the believed neighbours of a match predict its displacement
            (:func:`tensor_stereo.scores.consensus.consensus_score`); ``learned``, the calibrated probability of a small
            network (:func:`tensor_stereo.scores.learned.score_learned`), best with the evidence of the images;
            ``topology``, how far both neighbour sets agree: their soft Jaccard index, 1 iff Restriction 1 holds.
        consensus: settings of that score; None means the defaults, for rectified pairs.
        temperature: of ``topology``: below which dual Voronoi edges are hardly told from ties.
        unit: ``edge``: in lengths of the edge at hand, so that the score does not depend on scale; ``px``: in pixels.
        learnable_temperature: whether the temperature is a parameter (its logarithm is what is learnt); for
            ``topology``.
        threshold: verdict by score >= threshold instead of by ``restriction``.
        straight_through: the score is the verdict, with the gradient of the soft score.
        min_group_size: as in :func:`tensor_stereo.classify_matches`.
        tie_tolerance: as in :func:`tensor_stereo.classify_matches`.
        backend: as in :func:`tensor_stereo.classify_matches`.

    Raises:
        ValueError: for an unknown option, or a temperature outside 1e-9..1e9.

    Source: the verdict is Bustos, Vargas & Trujillo, CIARP 2016, section 3; the score is this library's.

    Example:
        >>> left = torch.rand(2, 50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> output = DelaunayFilter()(left, right)
        >>> output.inlier.all(), output.score.min() > 0.7
        (tensor(True), tensor(True))
    """

    log_temperature: Tensor

    def __init__(
        self,
        *,
        restriction: Restriction = "cardinality",
        score: Score = "consensus",
        consensus: ConsensusConfig | None = None,
        temperature: float = 1.0,
        unit: TemperatureUnit = "edge",
        learnable_temperature: bool = False,
        threshold: float | None = None,
        straight_through: bool = False,
        min_group_size: int = 4,
        tie_tolerance: float = 1e-3,
        backend: Backend = "auto",
    ) -> None:
        super().__init__()
        check_verdict(restriction, min_group_size)
        if score not in SCORES:
            raise ValueError(f"score must be one of {', '.join(SCORES)}, got {score!r}")
        if learnable_temperature and score != "topology":
            raise ValueError(f"learnable_temperature must be False where score is {score!r}, which has no temperature")
        self.consensus = ConsensusConfig() if consensus is None else consensus
        check_consensus(self.consensus)
        check_unit(unit)
        check_temperature(temperature)
        check_options(tie_tolerance, backend)
        if threshold is not None and not 0 <= threshold <= 1:
            raise ValueError(f"threshold must lie in [0, 1] or be None, got {threshold}")
        self.restriction = restriction
        self.score = score
        self.unit = unit
        self.threshold = threshold
        self.straight_through = straight_through
        self.min_group_size = min_group_size
        self.tie_tolerance = tie_tolerance
        self.backend = backend
        logarithm = torch.tensor(temperature, dtype=torch.float64).log()
        if learnable_temperature:
            self.log_temperature = nn.Parameter(logarithm)
        else:
            self.register_buffer("log_temperature", logarithm)

    @property
    def temperature(self) -> Tensor:
        """() float64, in ``unit``, whatever the dtype that the module is moved to."""
        return self.log_temperature.exp().clamp(COLDEST, HOTTEST)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DelaunayFilter:
        """Follow a move to another device, but not one to another dtype: the score is computed in float64."""
        super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)  # type: ignore[no-untyped-call]
        return self

    def forward(
        self,
        keypoints0: Tensor | Matches,
        keypoints1: Tensor | None = None,
        mask: Tensor | None = None,
        group: Tensor | None = None,
        cost: Tensor | None = None,
        *,
        evidence: ImageEvidence | None = None,
    ) -> FilterOutput:
        """Classify and score padded pairs, or a ragged batch given as the only argument.

        Args:
            keypoints0: (B, N, 2) float32 or float64 px of view 0, or :class:`Matches`. Pairs need not be rectified.
            keypoints1: (B, N, 2) px of view 1; row i of both is one match.
            mask: (B, N) bool, True for real matches; None means all. The padding may hold anything.
            group: (B, N) integer object groups.
            cost: (B, N), lower is better; decides between duplicates, and is evidence for consensus and learned.
            evidence: what the images say of the rows of ``Matches``, for learned:
                :func:`tensor_stereo.scores.evidence.measure_images`.

        Returns:
            ``inlier``, ``score`` and ``relation`` in the layout of the input. The score has the dtype of the keypoints,
            under autocast that of autocast. Gradients flow from it to both keypoints (and the temperature, and for
            consensus the cost), and are zero for untested matches; topology is not differentiable twice.

        Raises:
            ValueError: if shapes disagree, or as :func:`tensor_stereo.classify_matches`.
            TypeError: for keypoints in half precision, which cannot tell pixels apart beyond 256; for arguments beside
                ``Matches``.
        """
        if isinstance(keypoints0, Matches):
            rest = {"keypoints1": keypoints1, "mask": mask, "group": group, "cost": cost}
            for name in (name for name, value in rest.items() if value is not None):
                raise TypeError(f"{name} must be part of the Matches, not given beside them")
            return FilterOutput(*self._classify(keypoints0, evidence), keypoints0)
        if evidence is not None:
            raise TypeError("evidence must be that of Matches, got padded keypoints")
        mask = _check_padded(keypoints0, keypoints1, mask, group, cost)
        rows0, ptr = from_padded(keypoints0, mask)
        rows1, cost, group = (None if v is None else from_padded(v, mask)[0] for v in (keypoints1, cost, group))
        matches = Matches(rows0, rows1, ptr, cost, group)  # type: ignore[arg-type]
        inlier, score, relation = (_spread(rows, mask) for rows in self._classify(matches))
        return FilterOutput(inlier, score, relation, matches, mask)

    def _classify(self, matches: Matches, evidence: ImageEvidence | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """inlier, score and relation of every match."""
        if evidence is not None and self.score != "learned":
            raise TypeError(f"evidence must be None where score is {self.score!r}, which looks at no image")
        score, graphs = self._score(matches, evidence)
        verdict = classify_graphs(
            graphs, restriction=self.restriction, min_group_size=self.min_group_size, backend=self.backend
        )
        is_tested = verdict.relation != UNTESTED
        score = torch.where(is_tested, score, torch.zeros_like(score))
        device = matches.keypoints0.device.type
        low = torch.is_autocast_enabled(device)
        score = score.to(torch.get_autocast_dtype(device) if low else matches.keypoints0.dtype)
        inlier = verdict.inlier if self.threshold is None else is_tested & (score.detach() >= self.threshold)
        if self.straight_through:
            score = score + (inlier.to(score.dtype) - score).detach()
        return inlier, score, verdict.relation

    def _score(self, matches: Matches, evidence: ImageEvidence | None) -> tuple[Tensor, MatchGraphs]:
        """(M,) score of every vertex, and the hard graphs."""
        if self.score == "topology":
            options: dict[str, Any] = {"unit": self.unit, "tie_tolerance": self.tie_tolerance, "backend": self.backend}
            found = build_soft_graphs(matches, self.temperature, **options)
            return soft_jaccard(count_soft_neighbors(matches, found, self.temperature, **options)), found.graphs
        graphs = build_match_graphs(matches, tie_tolerance=self.tie_tolerance, backend=self.backend)
        if self.score == "consensus":
            return consensus_score(matches, graphs, self.consensus, backend=self.backend), graphs
        return score_learned(matches, graphs, evidence), graphs


def _check_padded(
    keypoints0: Tensor, keypoints1: Tensor | None, mask: Tensor | None, group: Tensor | None, cost: Tensor | None
) -> Tensor:
    """The mask; raises unless all shapes fit."""
    if keypoints1 is None:
        raise ValueError("keypoints1 must be given with keypoints0")
    for name, given in (("keypoints0", keypoints0), ("keypoints1", keypoints1)):
        if not torch.is_tensor(given):
            raise TypeError(f"{name} must be a tensor, got {type(given).__name__}")
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
    return torch.ones(keypoints0.shape[:2], dtype=torch.bool, device=keypoints0.device) if mask is None else mask


def _spread(rows: Tensor, mask: Tensor) -> Tensor:
    """(M,) rows -> (B, N), zero in the padding."""
    return torch.zeros_like(mask, dtype=rows.dtype).masked_scatter(mask, rows)
