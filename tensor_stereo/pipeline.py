"""Images -> features -> matches -> objects -> graphs -> verdicts and scores, for a list of pairs of any sizes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.batching import concatenate_features, split_features
from tensor_stereo.classification import apply_score, classify_graphs, mask_untested
from tensor_stereo.configs import PIPELINE_STAGES, PipelineConfig, Rectified
from tensor_stereo.dense.semi_global import SemiGlobalMaps, match_keypoints, match_semi_global
from tensor_stereo.features import detect_features, to_gray
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.matching import match_features
from tensor_stereo.objects import group_matches, label_objects
from tensor_stereo.scores.alignment import Alignment, estimate_alignment
from tensor_stereo.scores.by_name import ScoredMatches, score_matches
from tensor_stereo.scores.refine import mark_refined, refine_matches
from tensor_stereo.scores.repair import Origin, repair_matches
from tensor_stereo.scores.tolerance import probability_within
from tensor_stereo.types import Classification, Features, Matches

ImagePair = tuple[Tensor, Tensor]


@dataclass
class Stopwatch:
    """Seconds of wall time spent in each named stage."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PIPELINE_STAGES, 0.0))

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class PipelineOutput:
    """Everything the pipeline knows about a batch of pairs.

    Attributes:
        matches: the putative matches of all pairs, with ``group`` if the run was constrained.
        graphs: their Delaunay graphs, as they were judged: before refinement.
        classification: one verdict per match.
        score: (M,), higher is better, 0 for untested matches; None if the settings ask for none. ``learned``, the
            default, and ``consensus`` are the calibrated probability of an error of at most ``max_error_px``.
        seconds: wall time of each stage for the whole batch.
        cumulative: (M, 5) probabilities of an error of at most each of :data:`tensor_stereo.scores.TOLERANCES_PX`, 0
            for untested matches; None where the score is no probability.
        alignment: What the matches of each pair share, such as a row offset, which the score has taken out; None where
            it takes none out.
        domain: (B,) int8, values of :class:`tensor_stereo.scores.Domain`: why a pair lies outside of what the
            probability was calibrated on, 0 inside; None where there is no probability.
        origin: (M,) int8, values of :class:`tensor_stereo.scores.Origin`: which matches were refined or repaired.
    """

    matches: Matches
    graphs: MatchGraphs
    classification: Classification
    score: Tensor | None
    seconds: dict[str, float]
    cumulative: Tensor | None = None
    alignment: Alignment | None = None
    domain: Tensor | None = None
    origin: Tensor | None = None

    def probability(self, max_error_px: float) -> Tensor:
        """(M,) calibrated probability of an error of at most ``max_error_px``, from .5 to 5 px, without another run.

        At the tolerance of the settings it is ``score``, bit for bit; it never falls when the tolerance grows.

        Raises:
            ValueError: for another tolerance, or where the score is no probability.
        """
        found = probability_within(self.cumulative, max_error_px)
        return found if self.score is None else found.to(self.score.dtype)


def run_pipeline(pairs: Sequence[ImagePair], config: PipelineConfig = PipelineConfig()) -> PipelineOutput:
    """Detect, match, classify and score a list of pairs, rectified unless the settings say otherwise.

    Args:
        pairs: B pairs (image0, image1), each (C, H, W) uint8 or floating point in [0, 1], C = 1 or 3 (RGB). Sizes may
            differ between pairs; nothing is padded, and the result equals that of single runs bit for bit.
        config: settings of every step.

    Returns:
        The matches of all pairs with their verdicts and scores. No gradient.

    Raises:
        ValueError: if there is no pair, the views of a rectified one differ in size, or an image has another layout.
            Settings that ask for semi-global matching of pairs that are not rectified cannot be made.

    Example:
        >>> from tensor_stereo.datasets.synthetic.rendering import render_pair
        >>> pair = render_pair(0)
        >>> output = run_pipeline([(pair.image0, pair.image1)])
        >>> kept = output.classification.inlier
        >>> bool(output.score[kept].min() >= 0.5), bool(kept.sum() > 100)
        (True, True)
    """
    watch = Stopwatch()
    gray = to_gray_pairs(pairs, rectified=config.rectified)
    keypoints, matches = find_matches(gray, config, watch)
    if config.constrained:
        matches = group_pairs(gray, matches, config, watch)
    with watch.measure("graph"):
        graphs = build_match_graphs(matches, tie_tolerance=config.tie_tolerance, backend=config.backend)
    with watch.measure("relate"):
        verdict = classify_graphs(graphs, config)
    with watch.measure("score"):
        judged = judge_matches(matches, graphs, verdict, score_pairs(gray, matches, graphs, config), config)
    with watch.measure("improve"):
        judged = improve_pairs(gray, judged, keypoints, config)
    found = judged.found
    if found is None:
        return PipelineOutput(judged.matches, judged.graphs, judged.verdict, None, watch.seconds, origin=judged.origin)
    return PipelineOutput(
        judged.matches,
        judged.graphs,
        judged.verdict,
        judged.score,
        watch.seconds,
        mask_untested(found.cumulative, judged.verdict),
        found.alignment,
        found.domain,
        judged.origin,
    )


def to_gray_pairs(pairs: Sequence[ImagePair], *, rectified: Rectified = True) -> list[ImagePair]:
    """Convert colour once: every image becomes (1, 1, H, W) uint8.

    Raises:
        ValueError: if there is no pair, or the views of a rectified one differ in size.
    """
    if not pairs:
        raise ValueError("pairs must hold at least one pair, got an empty sequence")
    for b, (image0, image1) in enumerate(pairs):
        if image0.ndim != 3 or (rectified is True and image0.shape[-2:] != image1.shape[-2:]):
            shapes = f"{tuple(image0.shape)} and {tuple(image1.shape)}"
            raise ValueError(f"image0 and image1 of pair {b} must be (C, H, W) of one size, got {shapes}")
    return [(to_gray(image0[None]), to_gray(image1[None])) for image0, image1 in pairs]


def match_pairs(gray: Sequence[ImagePair], config: PipelineConfig, watch: Stopwatch) -> Matches:
    """Features of every image that needs them, then the putative matches of every pair."""
    return find_matches(gray, config, watch)[1]


def find_matches(gray: Sequence[ImagePair], config: PipelineConfig, watch: Stopwatch) -> tuple[Features, Matches]:
    """Features of view 0, and the putative matches, of every pair."""
    if config.matching.method == "sgbm":
        with watch.measure("detect"):
            keypoints = concatenate_features(detect_images([pair[0] for pair in gray], config))
        with watch.measure("match"):
            return keypoints, match_keypoints(keypoints, map_pairs(gray, config), config.matching)
    with watch.measure("detect"):
        features0, features1 = detect_pairs(gray, config)
    with watch.measure("match"):
        return features0, match_features(features0, features1, config)


def detect_pairs(gray: Sequence[ImagePair], config: PipelineConfig) -> tuple[Features, Features]:
    """Features of view 0 and of view 1 of every pair."""
    found = detect_images([pair[view] for view in (0, 1) for pair in gray], config)
    features0, features1 = (concatenate_features(part) for part in (found[: len(gray)], found[len(gray) :]))
    return features0, features1


def detect_images(images: Sequence[Tensor], config: PipelineConfig) -> list[Features]:
    """Features of each of a list of (1, 1, H, W) images of any sizes; those of one size share a batch."""
    of_size: dict[torch.Size, list[int]] = {}
    for k, image in enumerate(images):
        of_size.setdefault(image.shape, []).append(k)
    found: dict[int, Features] = {}
    for places in of_size.values():
        features = detect_features(torch.cat([images[k] for k in places]), config)
        found.update(zip(places, split_features(features), strict=True))
    return [found[k] for k in range(len(images))]


def map_pairs(gray: Sequence[ImagePair], config: PipelineConfig) -> SemiGlobalMaps:
    """Semi-global disparity maps of both views of every pair."""
    return match_semi_global(*_by_view(gray), config.sgbm)


def group_pairs(gray: Sequence[ImagePair], matches: Matches, config: PipelineConfig, watch: Stopwatch) -> Matches:
    """The same matches with the object group of Restriction 3."""
    with watch.measure("group"):
        labels0, labels1 = ([label_objects(pair[view], config.objects)[0] for pair in gray] for view in (0, 1))
        return replace(matches, group=group_matches(matches, labels0, labels1))


@torch.no_grad()
def score_pairs(
    gray: Sequence[ImagePair], matches: Matches, graphs: MatchGraphs, config: PipelineConfig
) -> ScoredMatches | None:
    """The score that the settings name of every match, in the dtype of the keypoints, also of untested ones.

    Args:
        gray: as :func:`to_gray_pairs` gives them; the score ``learned`` looks at them.
        matches: of these pairs.
        graphs: of these matches.
        config: names the score; ``none`` gives None.
    """
    if config.resolved_score == "none":
        return None
    images = _by_view(gray) if config.resolved_score == "learned" else None
    found = score_matches(matches, config, graphs, images=images)
    return found._replace(score=found.score.to(matches.keypoints0.dtype))


class Judged(NamedTuple):
    """Matches of B pairs, and what is decided about them.

    Attributes:
        matches: M matches.
        graphs: Their graphs.
        verdict: One per match.
        score: (M,), 0 for untested matches; None without one.
        found: Scores before the verdict, with their alignment; None without one.
        origin: (M,) int8, values of :class:`tensor_stereo.scores.Origin`.
    """

    matches: Matches
    graphs: MatchGraphs
    verdict: Classification
    score: Tensor | None
    found: ScoredMatches | None
    origin: Tensor


def judge_matches(
    matches: Matches,
    graphs: MatchGraphs,
    verdict: Classification,
    found: ScoredMatches | None,
    config: PipelineConfig,
) -> Judged:
    """The verdict that the settings want, from that of the graphs and from the scores, of matches as they came."""
    score = None
    if found is not None:
        verdict, score = apply_score(verdict, found.score, matches.ptr, config)
    origin = torch.full_like(verdict.relation, int(Origin.GIVEN))
    return Judged(matches, graphs, verdict, score, found, origin)


@torch.no_grad()
def improve_pairs(gray: Sequence[ImagePair], judged: Judged, keypoints: Features, config: PipelineConfig) -> Judged:
    """Repair rejected matches and judge all anew, and refine kept ones, as the settings say.

    Args:
        gray: As :func:`to_gray_pairs` gives them.
        judged: The matches as they came.
        keypoints: All keypoints of view 0, of which some have no match yet.
        config: ``repair`` and ``refine``, and all that decides.

    Returns:
        The matches after it. No gradient.
    """
    views = _by_view(gray)
    if config.repair:
        kept, alignment = judged.verdict.inlier, _known_alignment(judged, config)
        more = repair_matches(
            judged.matches,
            *views,
            kept,
            alignment,
            keypoints0=keypoints.keypoints,
            ptr0=keypoints.ptr,
            backend=config.backend,
        )
        matches = group_pairs(gray, more.matches, config, Stopwatch()) if config.constrained else more.matches
        graphs = build_match_graphs(matches, tie_tolerance=config.tie_tolerance, backend=config.backend)
        found = score_pairs(gray, matches, graphs, config)
        judged = judge_matches(matches, graphs, classify_graphs(graphs, config), found, config)
        judged = judged._replace(origin=more.origin)
    if config.refine:
        kept, alignment = judged.verdict.inlier, _known_alignment(judged, config)
        moved = refine_matches(judged.matches, *views, kept, alignment, judged.graphs, backend=config.backend)
        judged = judged._replace(matches=moved, origin=mark_refined(judged.matches, moved, judged.origin))
    return judged


def _known_alignment(judged: Judged, config: PipelineConfig) -> Alignment:
    if judged.found is not None and judged.found.alignment is not None:
        return judged.found.alignment
    return estimate_alignment(judged.matches, judged.graphs, rectified=config.rectified, backend=config.backend)


def _by_view(gray: Sequence[ImagePair]) -> tuple[list[Tensor], list[Tensor]]:
    """The images (1, H, W) of view 0, and those of view 1."""
    return [image0[0] for image0, _ in gray], [image1[0] for _, image1 in gray]
