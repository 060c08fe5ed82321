"""The classifier as a module: padded keypoints or ragged matches in, verdicts and scores out."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from tensor_stereo.batching import from_padded
from tensor_stereo.configs import SCORES, Backend, ClassifyConfig, ConsensusConfig, Restriction, Score, TemperatureUnit
from tensor_stereo.filters import FilterOutput, apply_score, check_verdict, classify_graphs
from tensor_stereo.ops.segments import check_options
from tensor_stereo.scores.consensus import check_consensus
from tensor_stereo.scores.evidence import ImageEvidence
from tensor_stereo.scores.scoring import score_matches
from tensor_stereo.soft import COLDEST, HOTTEST, check_temperature
from tensor_stereo.types import Matches, check_unit


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
        temperature_unit: ``edge``: in lengths of the edge at hand, so that the score does not depend on scale; ``px``:
            in pixels.
        learnable_temperature: whether the temperature is a parameter (its logarithm is what is learnt); for
            ``topology``.
        threshold: verdict by score >= threshold instead of by ``restriction``.
        target_sensitivity: verdict by the score: as many matches of a pair are kept as let expect that this fraction of
            the incorrect ones is rejected. For ``consensus`` and ``learned``, which are calibrated.
        min_precision: verdict by the score: as many are kept as let expect that this fraction of the kept ones is
            correct (the paper's negative predictive value). For ``consensus`` and ``learned``.
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
        temperature_unit: TemperatureUnit = "edge",
        learnable_temperature: bool = False,
        threshold: float | None = None,
        target_sensitivity: float | None = None,
        min_precision: float | None = None,
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
        check_unit(temperature_unit, "temperature_unit")
        check_temperature(temperature)
        check_options(tie_tolerance, backend)
        self.score: Score = score
        self.consensus = ConsensusConfig() if consensus is None else consensus
        check_consensus(self.consensus)
        self.straight_through = straight_through
        self.config = ClassifyConfig(
            restriction=restriction,
            min_group_size=min_group_size,
            tie_tolerance=tie_tolerance,
            backend=backend,
            score=score,
            temperature=temperature,
            temperature_unit=temperature_unit,
            threshold=threshold,
            target_sensitivity=target_sensitivity,
            min_precision=min_precision,
        )
        logarithm = torch.tensor(temperature, dtype=torch.float64).log()
        if learnable_temperature:
            self.log_temperature = nn.Parameter(logarithm)
        else:
            self.register_buffer("log_temperature", logarithm)

    @property
    def temperature(self) -> Tensor:
        """() float64, in ``temperature_unit``, whatever the dtype that the module is moved to."""
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
        config = self.config
        score, graphs = score_matches(
            matches,
            score=self.score,
            consensus=self.consensus,
            temperature=self.temperature,
            temperature_unit=config.temperature_unit,
            evidence=evidence,
            tie_tolerance=config.tie_tolerance,
            backend=config.backend,
        )
        verdict = classify_graphs(
            graphs, restriction=config.restriction, min_group_size=config.min_group_size, backend=config.backend
        )
        device = matches.keypoints0.device.type
        low = torch.is_autocast_enabled(device)
        score = score.to(torch.get_autocast_dtype(device) if low else matches.keypoints0.dtype)
        rectified = self.consensus.row_tolerance_px is not None
        verdict, score = apply_score(verdict, score, matches.ptr, config, rectified=rectified)
        if self.straight_through:
            score = score + (verdict.inlier.to(score.dtype) - score).detach()
        return verdict.inlier, score, verdict.relation


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
