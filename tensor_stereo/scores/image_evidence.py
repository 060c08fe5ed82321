"""Local image evidence for putative matches: does another place on the row explain the window better?

Windows around both keypoints of a match are held against the row of the other view, or against the epipolar line of
views that are not rectified, over a range of disparities that follows from the matches themselves, and near the match
once more along the slope of its surface. The measure is the
logarithm of the zero-mean sum of squared differences: but for a constant, the negative log-likelihood per degree of
freedom of Gaussian noise of unknown variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.configs import Backend
from tensor_stereo.features import list_images
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.ops._window_evidence import window_evidence
from tensor_stereo.ops.reference_evidence import DISC_PX, NEAR_PX, NUM_CURVES, NUM_VALUES
from tensor_stereo.scores.alignment.form import Alignment, align_matches, no_alignment
from tensor_stereo.scores.samplers import find_places, list_views, prepare_views
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches

__all__ = ["MAX_DISPARITIES", "NUM_CURVES", "NUM_VALUES", "ImageEvidence", "measure_images", "search_ranges"]

MAX_DISPARITIES = 256  # of one pair's search range
_DISC_PLACES = 2 * DISC_PX + 1


class ImageEvidence(NamedTuple):
    """What the images say about M matches.

    Windows have 15 x 15 px: 5 x 5 and 11 x 11 boxes, pixels like the centre, in a wide and in a tight window, and four
    halves of 11 x 11.

    Attributes:
        values: (M, :data:`NUM_VALUES`) float32. For the windows of view 0, then of view 1: log SSD at the 7 places
            around the match, less its minimum; log SSD and correlation at the match; by how much the best rival on the
            row is worse in both; share of rivals that are about as good or better; log distance of a better rival; log
            SSD of half windows, and by how much it is above its minimum; log variance and gradient; for windows along
            the slope of the surface log SSD at the 7 places, less its minimum, by how much it is lower than without
            slope, correlation, and where it is lowest. At last the difference of the grey levels, and how far the
            disparity lies outside of the search range.
        curve0: (M, 2, D) float32, log SSD of two windows in view 0 along the row of view 1, less that of the match,
            over pixels like the centre, in a wide and in a tight window, between -6 and 6; column k stands for
            disparity ``first + k`` px.
        curve1: (M, 2, D) float32, the same for the windows in view 1 along the row of view 0.
        first: (M,) float32 px.
        num_columns: (M,) int64 columns that the pair has; 0 without images.
        offset: (M,) float32 px, from the disparity of the match to the one nearby, at most 4 px away, that the windows
            of both views favour, to parts of a px.
    """

    values: Tensor
    curve0: Tensor
    curve1: Tensor
    first: Tensor
    num_columns: Tensor
    offset: Tensor


@torch.no_grad()
def measure_images(
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    matches: Matches,
    graphs: MatchGraphs,
    alignment: Alignment | None = None,
    *,
    backend: Backend = "auto",
) -> ImageEvidence:
    """Hold the windows of every match against each other and against the rows that they lie in.

    Args:
        images0: B images (C, H, W) of view 0, uint8 or floating point in [0, 1], C = 1 or 3 (RGB), of any sizes; or a
            batch (B, C, H, W).
        images1: their partners.
        matches: B pairs, keypoints in px of these images; outside of them the border is repeated.
        graphs: of the same matches; they tell which disparities to search.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views. View 1
            of pairs that are not rectified is seen in the frame of view 0, in px of view 0, and searched along epipolar
            lines; where there are none, up to 4 px around the match.
        backend: A name of :mod:`tensor_stereo.ops.backends`; both agree to 1e-4.

    Returns:
        One row per match, on the device of the keypoints; it does not depend on the other pairs. No gradient.

    Raises:
        ValueError: if the numbers of images and pairs, or of matches and nodes, differ.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> image = torch.arange(1200, dtype=torch.uint8).reshape(1, 30, 40)
        >>> points = torch.tensor([[9.0, 9.0], [20.0, 9.0], [9.0, 20.0]])
        >>> matches = Matches(points, points, torch.tensor([0, 3]))
        >>> measure_images([image], [image], matches, build_match_graphs(matches)).curve0.shape
        torch.Size([3, 2, 9])
    """
    views = [
        list_images(name, images, matches.num_pairs) for name, images in (("images0", images0), ("images1", images1))
    ]
    check_match_graphs(matches, graphs)
    if alignment is None:
        alignment = no_alignment(matches.num_pairs, matches.keypoints0)
    aligned = align_matches(matches, alignment)
    places = find_places(matches, aligned, estimate_slopes(aligned, graphs), alignment)
    ranges = [
        (first, count if has_rows else min(count, _DISC_PLACES))
        for (first, count), has_rows in zip(search_ranges(aligned, graphs), alignment.has_rows.tolist(), strict=True)
    ]
    device = matches.ptr.device
    first, counts = torch.tensor(ranges, dtype=torch.int64, device=device).reshape(-1, 2).unbind(1)
    pairs = list(prepare_views(views, matches, alignment))
    with torch.autocast(device.type, enabled=False):
        values, curve0, curve1, start, offset = window_evidence(
            *list_views(pairs, device),
            *places,
            matches.ptr,
            first,
            counts,
            alignment.has_rows,
            alignment.rectified,
            max((count for _, count in ranges), default=0),
            backend,
        )
    return ImageEvidence(values, curve0, curve1, start, counts.repeat_interleave(matches.ptr.diff()), offset)


def search_ranges(matches: Matches, graphs: MatchGraphs) -> list[tuple[int, int]]:
    """First disparity and number of disparities to search in each pair, in whole px.

    They cover what at least three neighbours on their rows support, in either view, but for 1 % at both ends, and 15 %
    of that span on either side. Of wider spans the :data:`MAX_DISPARITIES` with the most matches are searched.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> points = torch.tensor([[9.0, 9.0], [20.0, 9.0], [9.0, 20.0]])
    >>> matches = Matches(points, points - torch.tensor([30.0, 0.0]), torch.tensor([0, 3]))
    >>> search_ranges(matches, build_match_graphs(matches))
    [(26, 9)]
    """
    disparity = matches.disparity
    on_row = (matches.keypoints0[:, 1] - matches.keypoints1[:, 1]).abs() <= 1.5
    votes = torch.zeros_like(disparity)
    for adjacency in (graphs.adjacency0, graphs.adjacency1):
        i, j = adjacency.row_indices, adjacency.col_indices
        agrees = ((disparity[i] - disparity[j]).abs() <= 2) & on_row[i] & on_row[j]
        votes.index_add_(0, i, agrees.to(votes.dtype))
    ranges = []
    for start, stop in pairwise(matches.ptr.tolist()):
        values = disparity[start:stop].double()
        supported = values[votes[start:stop] >= 3]
        believed = supported if len(supported) >= 8 else values
        if not len(believed):
            ranges.append((0, 0))
            continue
        low, high = torch.quantile(believed, believed.new_tensor([0.01, 0.99])).tolist()
        margin = max(4.0, 0.15 * (high - low))
        first, last = math.floor(low - margin), math.ceil(high + margin)
        if last - first >= MAX_DISPARITIES:
            ordered = believed.sort().values
            begin = ordered.floor() - NEAR_PX
            within = torch.searchsorted(ordered, begin + MAX_DISPARITIES - NEAR_PX)
            within = within - torch.arange(len(ordered), device=ordered.device)
            first = int(begin[within.argmax()])
            last = first + MAX_DISPARITIES - 1
        ranges.append((first, last - first + 1))
    return ranges
