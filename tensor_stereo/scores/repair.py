"""Repair: rejected matches and keypoints without a partner are searched again where believed neighbours say.

The planes around the nearest kept matches predict where a partner lies on its row or epipolar line. Of the places near
these predictions that one is taken whose windows fit best, to a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.batching import batch_to_ptr, ptr_to_batch, select_matches
from tensor_stereo.delaunay.one_to_one import coincident_ids, first_of_coincident
from tensor_stereo.features import list_images
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops.samplers import Sampler, search_line
from tensor_stereo.ops.segments import to_points
from tensor_stereo.ops.windows import (
    LIKE,
    NUM_WHOLE,
    RADIUS_PX,
    TIGHT,
    compare_windows,
    parabola_offset,
    window_kernels,
)
from tensor_stereo.scores.alignment.form import Alignment, align_matches, map_points, no_alignment
from tensor_stereo.scores.image_evidence import MAX_DISPARITIES
from tensor_stereo.scores.samplers import Place, find_places, look_at_pairs
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches, check_mask, check_points, check_ptr, check_vector

_LEAST_KEPT = 4  # matches of a pair that predict for others
_NUM_NEIGHBORS = 8
_NEAR_PX = 3.0  # of a prediction
_NOWHERE = 40.0  # log SSD of a place that is not looked at
_ROWS_AT_ONCE = 192


class Origin(IntEnum):
    """Where a match comes from.

    >>> Origin(2).name
    'REPAIRED'
    """

    GIVEN = 0
    REFINED = 1  # moved to where the windows of both views fit best
    REPAIRED = 2  # with a partner that was searched again


class RepairedMatches(NamedTuple):
    """Matches with other partners, not yet scored.

    Attributes:
        matches: M matches of the same B pairs: in each pair those given, in their order, then those of keypoints that
            had no partner. The cost of repaired ones is infinite, so that scores leave costs out, and the given one is
            kept where two share a keypoint.
        rows: (M,) int64 rows of the given matches, -1 for keypoints that had no partner.
        origin: (M,) int8, values of :class:`Origin`.
    """

    matches: Matches
    rows: Tensor
    origin: Tensor


@torch.no_grad()
def repair_matches(
    matches: Matches,
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    kept: Tensor,
    alignment: Alignment | None = None,
    *,
    keypoints0: Tensor | None = None,
    ptr0: Tensor | None = None,
) -> RepairedMatches:
    """Give rejected matches, and keypoints without a partner, the partner that kept neighbours and images favour.

    Args:
        matches: B pairs, keypoints in px of the images.
        images0: B images (C, H, W) of view 0, as :func:`tensor_stereo.scores.image_evidence.measure_images` takes them.
        images1: Their partners.
        kept: (M,) bool, the matches to be believed, which stay as they are.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.
        keypoints0: (N, 2) px, keypoints of view 0; those that a match of their pair has already are left out.
        ptr0: (B + 1,) int64 offsets of ``keypoints0``; None for one pair.

    Returns:
        The matches. Pairs with fewer than four kept ones stay as they are. A pair does not depend on the others. No
        gradient.

    Raises:
        ValueError, TypeError: for images, masks or keypoints that do not fit the matches.

    >>> from tensor_stereo.datasets.synthetic.rendering import render_pair
    >>> pair = render_pair(2)
    >>> left = torch.cartesian_prod(torch.arange(60, 340, 12), torch.arange(30, 270, 12)).double()
    >>> disparity = pair.disparity_gt[left[:, 1].long(), left[:, 0].long()].double()
    >>> disparity[::3] += 20  # wrong
    >>> matches = Matches(left, left - torch.stack([disparity, 0 * disparity], 1), torch.tensor([0, len(left)]))
    >>> kept = torch.arange(len(left)) % 3 > 0
    >>> found = repair_matches(matches, [pair.image0], [pair.image1], kept).matches
    >>> bool(((found.disparity - disparity + 20)[::3].abs() < 1).double().mean() > 0.6)
    True
    """
    views = [list_images(name, x, matches.num_pairs) for name, x in (("images0", images0), ("images1", images1))]
    check_vector("kept", kept, matches.num_matches)
    check_mask("kept", kept)
    if alignment is None:
        alignment = no_alignment(matches.num_pairs, matches.keypoints0)
    targets = _collect_targets(matches, kept, *_list_keypoints(matches, keypoints0, ptr0))
    partners, found = _search(views, matches, kept, targets, alignment)
    return _join(matches, targets, partners, found)


class _Targets(NamedTuple):
    """Keypoints of view 0 that look for a partner, pair by pair."""

    points: Tensor  # (T, 2) float64 px
    rows: Tensor  # (T,) int64 rows of the matches, -1 for keypoints without one
    ptr: Tensor  # (B + 1,)


def _list_keypoints(matches: Matches, keypoints0: Tensor | None, ptr0: Tensor | None) -> tuple[Tensor, Tensor]:
    """(N, 2) float64 keypoints and (N,) their pairs; raises unless they fit."""
    if keypoints0 is None:
        return matches.keypoints0[:0].double(), matches.ptr[:0]
    if ptr0 is None:
        if matches.num_pairs != 1:
            raise ValueError(f"ptr0 must be given with keypoints0 of {matches.num_pairs} pairs")
        check_points("keypoints0", keypoints0)
        ptr0 = matches.ptr.new_tensor([0, len(keypoints0)])
    check_ptr("ptr0", ptr0, len(keypoints0))
    if ptr0.shape != matches.ptr.shape:
        raise ValueError(f"ptr0 must be offsets of {matches.num_pairs} pairs, got those of {len(ptr0) - 1}")
    to_points("keypoints0", keypoints0, ptr0)  # none is NaN
    return keypoints0.double(), ptr_to_batch(ptr0)


def _collect_targets(matches: Matches, kept: Tensor, keypoints: Tensor, batch: Tensor) -> _Targets:
    """Rejected matches whose keypoint no kept match has, and keypoints that no match has, each place once."""
    points = torch.cat([matches.keypoints0.detach().double(), keypoints])
    pairs = torch.cat([ptr_to_batch(matches.ptr), batch])
    ids = coincident_ids(*(values.numpy(force=True) for values in (points, pairs)))
    is_first = torch.from_numpy(first_of_coincident(ids)).to(pairs.device)
    places = torch.from_numpy(ids).to(pairs.device)
    taken = torch.zeros_like(is_first).index_fill(0, places[: matches.num_matches][kept], True)
    rows = (is_first & ~taken[places]).nonzero()[:, 0]
    order, ptr = _by_pair(pairs[rows], matches.num_pairs)
    rows = rows[order]
    return _Targets(points[rows], torch.where(rows < matches.num_matches, rows, -1), ptr)


def _by_pair(pairs: Tensor, num_pairs: int) -> tuple[Tensor, Tensor]:
    """The stable order that sorts rows by their pairs, and the offsets of the pairs in it."""
    order = pairs.argsort(stable=True)
    return order, batch_to_ptr(pairs[order], num_pairs)


def _search(
    views: Sequence[Sequence[Tensor]], matches: Matches, kept: Tensor, targets: _Targets, alignment: Alignment
) -> tuple[Tensor, Tensor]:
    """(T, 2) partners of the targets, and (T,) whether one was found."""
    known = select_matches(matches, kept)
    back = torch.linalg.inv_ex(alignment.to_view0)[0]
    there = map_points(back, targets.points, ptr_to_batch(targets.ptr))
    # in one batch behind the known ones, so that lines of both point the same way; each target is its own partner
    order, ptr = _by_pair(torch.cat([ptr_to_batch(known.ptr), ptr_to_batch(targets.ptr)]), matches.num_pairs)
    left = torch.cat([known.keypoints0.double(), targets.points])[order]
    both = Matches(left, torch.cat([known.keypoints1.double(), there])[order], ptr)
    aligned = align_matches(both, alignment)
    places = find_places(both, aligned, torch.zeros_like(left, dtype=torch.float32), alignment)
    is_known = order < known.num_matches
    of_known = Matches(aligned.keypoints0[is_known], aligned.keypoints1[is_known], known.ptr)
    slope = estimate_slopes(of_known, build_match_graphs(known)).double()
    disparity = of_known.keypoints0[:, 0] - of_known.keypoints1[:, 0]
    partners, found = there.clone(), torch.zeros(len(there), dtype=torch.bool, device=there.device)
    offsets, starts = known.ptr.tolist(), targets.ptr.tolist()
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        for b, (looks, own) in enumerate(look_at_pairs(views, both, places, alignment)):
            mine, whole = slice(offsets[b], offsets[b + 1]), slice(starts[b], starts[b + 1])
            count = offsets[b + 1] - offsets[b]
            if count < _LEAST_KEPT or whole.start == whole.stop:
                continue
            seats = aligned.keypoints0[both.ptr[b] : both.ptr[b + 1]]
            predicted = _predict(seats[count:], seats[:count], disparity[mine], slope[mine])
            first, width = _range(predicted, disparity[mine])
            for rows in torch.arange(len(predicted), device=seats.device).split(_ROWS_AT_ONCE):  # type: ignore[no-untyped-call]
                seen, place = [look.select(count + rows) for look in looks], own.select(count + rows)
                best, is_inside = _best_disparity(seen, place, predicted[rows].float(), first, width)
                moved = seen[1].place(place.left, -best, place.across).double()
                partners[whole.start + rows] = map_points(back, moved, torch.full_like(rows, b))
                found[whole.start + rows] = is_inside
    return partners, found


def _predict(points: Tensor, known: Tensor, disparity: Tensor, slope: Tensor) -> Tensor:
    """(T, K) disparities that the planes around the nearest known matches predict."""
    count = min(_NUM_NEIGHBORS, len(known))
    parts = [
        torch.cdist(part, known, compute_mode="donot_use_mm_for_euclid_dist").topk(count, largest=False).indices
        for part in points.split(_ROWS_AT_ONCE)  # type: ignore[no-untyped-call]
    ]
    near = torch.cat(parts)
    way = points[:, None] - known[near]
    in_view0 = slope / (1 + slope[:, :1] / 2)  # from the cyclopean frame
    return disparity[near] + (in_view0[near] * way).sum(2)


def _range(predicted: Tensor, disparity: Tensor) -> tuple[int, int]:
    """First disparity and number of disparities that the search of a pair covers, in whole px."""
    low, high = float(predicted.min()) - _NEAR_PX - 1, float(predicted.max()) + _NEAR_PX + 1
    middle = float(disparity.median())
    low = max(low, middle - MAX_DISPARITIES)
    high = min(high, middle + MAX_DISPARITIES)
    first = int(low // 1)
    return first, max(int(high // 1) + 2 - first, 3)


def _best_disparity(
    looks: Sequence[Sampler], places: Place, predicted: Tensor, first: int, count: int
) -> tuple[Tensor, Tensor]:
    """(m,) px to a fraction, and whether a place near a prediction lies inside of view 1."""
    windows = looks[0].windows(places.left, RADIUS_PX)
    kernels = window_kernels(windows)[..., :NUM_WHOLE]
    lowest = torch.full_like(places.across, first)
    strips, outside = search_line(looks[1], places.left, places.across, lowest, count, reverse=True)
    cost, _, _ = compare_windows(windows, strips, kernels, has_tight=True)
    cost = cost.flip(1)[..., [LIKE, TIGHT]].mean(2)
    disparity = first + torch.arange(count, device=cost.device, dtype=cost.dtype)
    near = ((disparity[:, None] - predicted[:, None]).abs() <= _NEAR_PX).any(2)
    allowed = near & ~outside.flip(1)
    k = cost.masked_fill(~allowed, _NOWHERE).argmin(1, keepdim=True).clamp(1, count - 2)
    return disparity[k[:, 0]] + parabola_offset(cost.exp(), k).clamp(-0.5, 0.5), allowed.any(1)


def _join(matches: Matches, targets: _Targets, partners: Tensor, found: Tensor) -> RepairedMatches:
    """The given matches with new partners, and the free keypoints behind those of their pair."""
    batch, count = ptr_to_batch(matches.ptr), matches.num_matches
    replaced, new = ((found & chosen).nonzero()[:, 0] for chosen in (targets.rows >= 0, targets.rows < 0))
    right = matches.keypoints1.double().clone()
    right[targets.rows[replaced]] = partners[replaced]
    cost = torch.zeros(count, dtype=torch.float64, device=right.device)
    cost = cost if matches.cost is None else matches.cost.double().clone()
    cost[targets.rows[replaced]] = torch.inf
    origin = torch.full((count,), Origin.GIVEN, dtype=torch.int8, device=right.device)
    origin[targets.rows[replaced]] = int(Origin.REPAIRED)
    pairs = torch.cat([batch, ptr_to_batch(targets.ptr)[new]])
    order, ptr = _by_pair(pairs, matches.num_pairs)

    def join(given: Tensor, more: Tensor) -> Tensor:
        return torch.cat([given, more.to(given.dtype)]).index_select(0, order)

    rows = torch.arange(count, device=right.device)
    dtype = matches.keypoints0.dtype
    joined = Matches(
        join(matches.keypoints0, targets.points[new]),
        join(right, partners[new]).to(dtype),
        ptr,
        join(cost, torch.full((len(new),), torch.inf)),
        None if matches.group is None else join(matches.group, torch.zeros(len(new))),
    )
    return RepairedMatches(
        joined, join(rows, torch.full((len(new),), -1)), join(origin, torch.full((len(new),), int(Origin.REPAIRED)))
    )
