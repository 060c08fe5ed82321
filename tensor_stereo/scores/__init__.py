"""Scores of putative matches: a learned probability, consensus without weights, and the topology of both graphs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.scores.alignment import Alignment as Alignment
    from tensor_stereo.scores.alignment import align_matches as align_matches
    from tensor_stereo.scores.alignment import estimate_alignment as estimate_alignment
    from tensor_stereo.scores.alignment import fit_alignment as fit_alignment
    from tensor_stereo.scores.by_name import ScoredMatches as ScoredMatches
    from tensor_stereo.scores.by_name import score_matches as score_matches
    from tensor_stereo.scores.calibration import calibrate_consensus as calibrate_consensus
    from tensor_stereo.scores.calibration import keep_by_target as keep_by_target
    from tensor_stereo.scores.consensus import consensus_belief as consensus_belief
    from tensor_stereo.scores.consensus import consensus_probabilities as consensus_probabilities
    from tensor_stereo.scores.consensus import consensus_score as consensus_score
    from tensor_stereo.scores.domain import Domain as Domain
    from tensor_stereo.scores.domain import DomainWarning as DomainWarning
    from tensor_stereo.scores.domain import describe_domain as describe_domain
    from tensor_stereo.scores.image_evidence import ImageEvidence as ImageEvidence
    from tensor_stereo.scores.image_evidence import measure_images as measure_images
    from tensor_stereo.scores.learned import LearnedScore as LearnedScore
    from tensor_stereo.scores.learned import learned_probabilities as learned_probabilities
    from tensor_stereo.scores.learned import load_learned as load_learned
    from tensor_stereo.scores.learned import score_learned as score_learned
    from tensor_stereo.scores.refine import refine_matches as refine_matches
    from tensor_stereo.scores.repair import Origin as Origin
    from tensor_stereo.scores.repair import RepairedMatches as RepairedMatches
    from tensor_stereo.scores.repair import repair_matches as repair_matches
    from tensor_stereo.scores.slopes import estimate_slopes as estimate_slopes
    from tensor_stereo.scores.tolerance import TOLERANCES_PX as TOLERANCES_PX
    from tensor_stereo.scores.tolerance import probability_within as probability_within

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Alignment": "alignment",
        "Domain": "domain",
        "DomainWarning": "domain",
        "ImageEvidence": "image_evidence",
        "LearnedScore": "learned",
        "Origin": "repair",
        "RepairedMatches": "repair",
        "ScoredMatches": "by_name",
        "TOLERANCES_PX": "tolerance",
        "align_matches": "alignment",
        "calibrate_consensus": "calibration",
        "consensus_belief": "consensus",
        "consensus_probabilities": "consensus",
        "consensus_score": "consensus",
        "describe_domain": "domain",
        "estimate_alignment": "alignment",
        "estimate_slopes": "slopes",
        "fit_alignment": "alignment",
        "keep_by_target": "calibration",
        "learned_probabilities": "learned",
        "load_learned": "learned",
        "measure_images": "image_evidence",
        "probability_within": "tolerance",
        "refine_matches": "refine",
        "repair_matches": "repair",
        "score_learned": "learned",
        "score_matches": "by_name",
    },
)
