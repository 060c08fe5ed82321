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
from tensor_stereo.configs import Backend
from tensor_stereo.delaunay.one_to_one import coincident_ids, first_of_coincident
from tensor_stereo.features import list_images
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops._window_search import window_search
from tensor_stereo.ops.segments import to_points
from tensor_stereo.scores.alignment.form import Alignment, align_matches, map_points, no_alignment
from tensor_stereo.scores.image_evidence import MAX_DISPARITIES
from tensor_stereo.scores.samplers import find_places, list_views, prepare_views
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches, check_mask, check_points, check_ptr, check_vector

_LEAST_KEPT = 4  # matches of a pair that predict for others
_NUM_NEIGHBORS = 8
_NEAR_PX = 3.0  # of a prediction
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
    backend: Backend = "auto",
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
        backend: A name of :mod:`tensor_stereo.ops.backends`.

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
    partners, found = _search(views, matches, kept, targets, alignment, backend)
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
    views: Sequence[Sequence[Tensor]],
    matches: Matches,
    kept: Tensor,
    targets: _Targets,
    alignment: Alignment,
    backend: Backend,
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
    offsets, starts, bounds = known.ptr.tolist(), targets.ptr.tolist(), both.ptr.tolist()
    predicted, ranges = [targets.points.new_zeros(0, _NUM_NEIGHBORS)], []
    for b in range(matches.num_pairs):
        mine, count = slice(offsets[b], offsets[b + 1]), offsets[b + 1] - offsets[b]
        seats = aligned.keypoints0[bounds[b] : bounds[b + 1]]
        if count < _LEAST_KEPT or starts[b] == starts[b + 1]:
            predicted.append(seats.new_full((starts[b + 1] - starts[b], _NUM_NEIGHBORS), torch.nan))
            ranges.append((0, 3))
            continue
        predicted.append(_predict(seats[count:], seats[:count], disparity[mine], slope[mine]))
        ranges.append(_range(predicted[-1], disparity[mine]))
    first, counts = torch.tensor(ranges, dtype=torch.int64, device=there.device).reshape(-1, 2).unbind(1)
    own = places.select(~is_known)
    pairs = list(prepare_views(views, both, alignment))
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        best, found = window_search(
            *list_views(pairs, there.device), own.left, own.along, own.across, torch.cat(predicted).float(),
            targets.ptr, first, counts, alignment.rectified, _NEAR_PX, backend,
        )  # fmt: skip
    x, y = own.along.unbind(1)
    line = torch.stack([-y, x], 1)
    moved = (own.left - best[:, None] * own.along + own.across[:, None] * line).double()
    return map_points(back, moved, ptr_to_batch(targets.ptr)), found


def _predict(points: Tensor, known: Tensor, disparity: Tensor, slope: Tensor) -> Tensor:
    """(T, K) disparities that the planes around the nearest known matches predict."""
    count = min(_NUM_NEIGHBORS, len(known))
    parts = [
        torch.cdist(part, known, compute_mode="donot_use_mm_for_euclid_dist").topk(count, largest=False).indices
        for part in points.split(_ROWS_AT_ONCE)  # type: ignore[no-untyped-call]
    ]
    near = torch.cat(parts)
    near = torch.cat([near, near[:, -1:].expand(-1, _NUM_NEIGHBORS - count)], 1)  # all pairs have as many
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
