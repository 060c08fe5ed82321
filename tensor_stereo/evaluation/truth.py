"""Which matches are correct, by ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.sampling import sample_nearest
from tensor_stereo.scores.alignment import fit_alignment
from tensor_stereo.types import Matches, check_points, check_vector

_ALIGNING_PX = 2.0  # largest error of the disparity of matches that tell how the rows of a pair agree


def errors_against_gt(matches: Matches, disparity_gt: Tensor | Sequence[Tensor]) -> Tensor:
    """How far every match of rectified pairs is from ground truth at the nearest pixel of its left keypoint.

    The error is the larger one of disparity and row. Rows count after the row offset and slow drift that all matches of
    a pair share, which :func:`tensor_stereo.scores.alignment.fit_alignment` finds on those whose disparity is right
    within 2 px; fewer than 12 such matches share none. Coordinates are rounded half to even; keypoints up to 1 px
    outside the image read the border. No gradient.

    Args:
        matches: M matches of B pairs.
        disparity_gt: (B, H, W) floating point, or B maps (H_b, W_b) where sizes differ; x0 - x1 in px of view 0. NaN
            and infinite values are unknown; 0 is a disparity.

    Returns:
        (M,) float64 px of view 0, NaN where ground truth is unknown; infinite for a keypoint that is no number.

    Raises:
        ValueError: if there is not one map per pair, or a keypoint lies more than 1 px outside its image.
        TypeError: if a map does not hold floating point values.

    Source: the paper, section 4, which looks at the disparity alone.

    Example:
        >>> left = torch.tensor([[5.0, 0.0], [6.0, 0.0], [5.0, 2.0]])
        >>> right = torch.tensor([[2.0, 0.0], [1.0, 0.0], [2.0, 3.5]])  # another disparity, another row
        >>> matches = Matches(left, right, ptr=torch.tensor([0, 3]))
        >>> errors_against_gt(matches, torch.full((1, 4, 8), 3.0))
        tensor([0.0000, 2.0000, 1.5000], dtype=torch.float64)
    """
    for b, disparity in enumerate(disparity_gt):
        if not disparity.is_floating_point():
            raise TypeError(
                f"disparity_gt of pair {b} must be floating point with NaN for unknown, got {disparity.dtype}"
            )
    truth = sample_nearest(disparity_gt, matches.keypoints0, matches.ptr, name="keypoints0").double()
    # the difference of two float32 coordinates is exact in float64, so an error of just 1 px stays one
    disparity, rows = (matches.keypoints0.detach().double() - matches.keypoints1.detach().double()).unbind(1)
    error = torch.where(truth.isfinite(), (truth - disparity).abs(), torch.nan)
    near = (error <= _ALIGNING_PX) & rows.isfinite()
    shift = fit_alignment(matches, near).row_shift(matches)
    error = torch.maximum(error, (rows + shift).abs())
    return torch.where(truth.isfinite(), error.nan_to_num(nan=torch.inf), torch.nan)


def errors_to_partners(matches: Matches, partners_gt: Tensor, scale_gt: Tensor | None = None) -> Tensor:
    """How far every match of views that need not be rectified is from its true partner.

    The distance from ``keypoints1`` to the true partner is divided by the local scale of view 1 against view 0, so that
    it is in px of view 0: where view 1 shows things twice as large, it may be twice as many px of view 1. No gradient.

    Args:
        matches: M matches of B pairs.
        partners_gt: (M, 2) floating point, (x, y) in px of view 1, where the point at ``keypoints0`` truly is; it may
            lie outside of the image. A row with a value that is not finite is unknown.
        scale_gt: (M,) floating point, positive: how many px of view 1 there are to a px of view 0 around the match,
            such as the root of the determinant of the Jacobian of the true map between the views. NaN where the partner
            is unknown or the scale itself is. None: 1 for all.

    Returns:
        (M,) float64 px of view 0, NaN where partner or scale is unknown; infinite for a keypoint that is no number.

    Raises:
        ValueError: if ``partners_gt`` or ``scale_gt`` does not have one row per match, or a scale is not positive.
        TypeError: if ``partners_gt`` or ``scale_gt`` does not hold floating point values.

    Example:
        >>> left = torch.tensor([[5.0, 0.0], [6.0, 0.0]])
        >>> matches = Matches(left, 2 * left + torch.tensor([[0.0, 0.0], [3.0, 4.0]]), ptr=torch.tensor([0, 2]))
        >>> errors_to_partners(matches, 2 * left, torch.tensor([2.0, 2.0]))
        tensor([0.0000, 2.5000], dtype=torch.float64)
    """
    check_points("partners_gt", partners_gt)
    if len(partners_gt) != matches.num_matches:
        raise ValueError(f"partners_gt must have one row per match ({matches.num_matches}), got {len(partners_gt)}")
    distance = (matches.keypoints1.detach().double() - partners_gt.detach().double()).norm(dim=1)
    known = partners_gt.isfinite().all(1)
    if scale_gt is not None:
        check_vector("scale_gt", scale_gt, matches.num_matches)
        if not scale_gt.is_floating_point():
            raise TypeError(f"scale_gt must be floating point with NaN for unknown, got {scale_gt.dtype}")
        bad = (scale_gt <= 0) | scale_gt.isinf()
        if bool(bad.any()):
            value = float(scale_gt[bad][0])
            raise ValueError(f"scale_gt must be positive and finite, or NaN where it is unknown, got {value}")
        distance, known = distance / scale_gt.detach().double(), known & scale_gt.isfinite()
    finite = matches.keypoints0.isfinite().all(1) & matches.keypoints1.isfinite().all(1)
    return torch.where(known, distance.where(finite, torch.inf), torch.nan)


def matches_against_gt(
    matches: Matches, disparity_gt: Tensor | Sequence[Tensor], *, max_error_px: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Tell which matches of rectified pairs are correct: those whose error is at most ``max_error_px``.

    Args:
        matches: M matches of B pairs.
        disparity_gt: as for :func:`errors_against_gt`, whose errors count.
        max_error_px: largest error of a correct match, in px of view 0; an error of just that is one.

    Returns:
        correct (M,) bool, False where ground truth is unknown, and valid (M,) bool, True where it is known.

    Raises:
        ValueError: if ``max_error_px`` is negative, and as :func:`errors_against_gt`, like TypeError.

    Example:
        >>> left, right = torch.tensor([[5.0, 0.0], [6.0, 0.0]]), torch.tensor([[2.0, 0.0], [1.0, 0.0]])
        >>> matches = Matches(left, right, ptr=torch.tensor([0, 2]))
        >>> matches_against_gt(matches, torch.full((1, 4, 8), 3.0))
        (tensor([ True, False]), tensor([True, True]))
    """
    if not max_error_px >= 0:
        raise ValueError(f"max_error_px must not be negative, got {max_error_px}")
    error = errors_against_gt(matches, disparity_gt)
    return error <= max_error_px, ~error.isnan()
