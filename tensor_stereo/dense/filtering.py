"""Dense disparity maps: verdicts on a grid of their pixels, by the confidence of the map or by a filter of matches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.batching import lengths_to_ptr, select_matches
from tensor_stereo.delaunay.one_to_one import coincident_ids, first_of_coincident
from tensor_stereo.dense.confidence import score_disparity
from tensor_stereo.modules import DelaunayFilter, FilterOutput, Images
from tensor_stereo.ops.segments import pair_of, to_points
from tensor_stereo.types import Matches, check_mask, check_pixels, check_tensor


class FilteredDisparity(NamedTuple):
    """Verdicts on the grid of B disparity maps; H' = ceil(H / stride), W' = ceil(W / stride).

    Attributes:
        inlier: (B, 1, H', W') bool; False where there is no match, or a hidden one.
        score: (B, 1, H', W') in [0, 1], higher is better; 0 where there is no match, or a hidden one. None if the
            filter has none.
        mask: (B, 1, H', W') bool, grid points that are matches: known, not masked out, and inside view 1.
        grid: (H', W', 2) their (x, y) in px of view 0.
    """

    inlier: Tensor
    score: Tensor | None
    mask: Tensor
    grid: Tensor


def filter_disparity(
    disparity: Tensor,
    stride: int,
    *,
    filter: Callable[..., FilterOutput] | None = None,  # noqa: A002
    mask: Tensor | None = None,
    images0: Images | None = None,
    images1: Images | None = None,
) -> FilteredDisparity:
    """Decide which grid points of a disparity map are right.

    With images and without ``filter`` this is :func:`tensor_stereo.score_disparity` on a grid: ``score`` is the
    calibrated probability of an error of at most 1 px, and points of at least .5 are inliers.

    Otherwise the point (x, y) and its disparity d are the match (x, y) -> (x - d, y), and a filter of matches decides,
    without images :class:`tensor_stereo.DelaunayFilter`: whether the neighbours in the grid stay neighbours in view 1.
    Points that meet in view 1 at the same place hide each other: the filter sees the one of the largest disparity,
    which is the nearest surface, and the others are no inliers. A region that is wrong as a whole, shifted by one
    constant, looks like an object and is kept inside.

    The result stays on the grid, because the pixels between were not looked at; it belongs to ``disparity[...,
    ::stride, ::stride]``.

    Args:
        disparity: (B, 1, H, W) float32 or float64, x0 - x1 in px, of any sign; (H, W) for one map, then without these
            axes in ``mask`` and in the result. NaN and infinite values are no matches, nor are those whose partner lies
            outside columns 0..W - 1.
        stride: distance of the grid's points in px, at least 1. The grid starts at pixel (0, 0).
        filter: takes the matches that are not hidden, as Matches without cost, and returns a FilterOutput; None: the
            confidence of the map where there are images, else ``DelaunayFilter()``.
        mask: (B, 1, H, W) bool; where it is False, disparities are no matches. None means all.
        images0: Images of view 0, the view of the map: (B, C, H, W), or a list of (C, H, W); handed to the filter if
            there is one, of any size then.
        images1: Images of view 1.

    Returns:
        Verdicts on the grid, each map by itself. If the filter's score is differentiable, gradients flow from it to the
        disparities of the matches that it sees; they are 0 elsewhere.

    Raises:
        ValueError: if shapes are others, ``stride`` is below 1, or a partner's column is below 1e-60 px without being 0
            (float64 only).
        TypeError: if ``disparity`` is no tensor of float32 or float64, ``mask`` none of bool, or ``stride`` no integer.

    Example:
        >>> disparity = torch.full((1, 1, 32, 32), 3.0)
        >>> result = filter_disparity(disparity, 8)
        >>> result.inlier[0, 0]
        tensor([[False,  True,  True,  True],
                [False,  True,  True,  True],
                [False,  True,  True,  True],
                [False,  True,  True,  True]])
    """
    check_tensor("disparity", disparity)
    check_pixels("disparity", disparity)
    if mask is not None:
        check_mask("mask", mask)
    if disparity.ndim == 2:
        mask = None if mask is None else mask[None, None]
        result = filter_disparity(
            disparity[None, None], stride, filter=filter, mask=mask, images0=images0, images1=images1
        )
        inlier, score, found = (None if values is None else values[0, 0] for values in result[:3])
        return FilteredDisparity(inlier, score, found, result.grid)  # type: ignore[arg-type]
    if disparity.ndim != 4 or disparity.shape[1] != 1:
        raise ValueError(f"disparity must have shape (B, 1, H, W), or (H, W) for one map, got {tuple(disparity.shape)}")
    if not isinstance(stride, int):
        raise TypeError(f"stride must be an integer number of px, got {stride!r}")
    if stride < 1:
        raise ValueError(f"stride must be at least 1 px, got {stride}")
    if mask is not None and mask.shape != disparity.shape:
        raise ValueError(f"mask must have the shape {tuple(disparity.shape)} of disparity, got {tuple(mask.shape)}")
    height, width = disparity.shape[2:]
    rows = torch.arange(0, height, stride, dtype=disparity.dtype, device=disparity.device)
    columns = torch.arange(0, width, stride, dtype=disparity.dtype, device=disparity.device)
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)  # (H', W', 2)
    sampled = disparity[:, 0, ::stride, ::stride]  # (B, H', W')
    partner = grid[..., 0] - sampled.detach()
    found = (partner >= 0) & (partner <= width - 1)  # False for NaN and infinity
    if mask is not None:
        found &= mask[:, 0, ::stride, ::stride]
    if filter is None and images0 is not None and images1 is not None:
        known = disparity if mask is None else disparity.masked_fill(~mask, torch.nan)
        scored = score_disparity(known, images0, images1, stride=stride)
        probability = scored.probability * found[:, None]
        return FilteredDisparity(scored.keep() & found[:, None], probability, found[:, None], grid)
    # Select before computing: a NaN that meets the graph would back-propagate.
    values = sampled[found]  # (M,)
    keypoints0 = grid.expand(*found.shape, 2)[found]
    keypoints1 = torch.stack([keypoints0[:, 0] - values, keypoints0[:, 1]], dim=1)
    matches = Matches(keypoints0, keypoints1, lengths_to_ptr(found.sum((1, 2))))
    nearest = _nearest_at_each_partner(matches)
    images = {} if images0 is None and images1 is None else {"images0": images0, "images1": images1}
    output = (DelaunayFilter() if filter is None else filter)(select_matches(matches, nearest), **images)
    seen = torch.zeros_like(found).masked_scatter(found, nearest)
    inlier = torch.zeros_like(found).masked_scatter(seen, output.inlier)
    score = None
    if output.score is not None:
        score = torch.zeros_like(found, dtype=output.score.dtype).masked_scatter(seen, output.score)[:, None]
    return FilteredDisparity(inlier[:, None], score, found[:, None], grid)


def _nearest_at_each_partner(matches: Matches) -> Tensor:
    """(M,) bool, the largest disparity at every place of view 1: the last one, as each row is listed from the left."""
    ids = coincident_ids(to_points("keypoints1", matches.keypoints1, matches.ptr), pair_of(matches.ptr))
    return torch.from_numpy(first_of_coincident(ids[::-1])[::-1].copy()).to(matches.keypoints0.device)
