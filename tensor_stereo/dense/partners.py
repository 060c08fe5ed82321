"""Keypoints and a disparity map -> matches: the map says where the partner of every keypoint lies."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch, select_matches
from tensor_stereo.delaunay.one_to_one import coincident_ids, keep_one_to_one
from tensor_stereo.ops.segments import pair_of, to_points
from tensor_stereo.sampling import sample_nearest
from tensor_stereo.types import Matches, check_pixels, check_points, check_ptr, check_tensor

Maps = Tensor | Sequence[Tensor]


@torch.no_grad()
def sample_disparity(
    disparity: Maps, keypoints: Tensor, ptr: Tensor | None = None, *, disparity1: Maps | None = None
) -> Matches:
    """Read the partners of keypoints from a disparity map, such as a network's.

    The keypoint (x, y) of view 0 whose nearest pixel has the disparity d is the match (x, y) -> (x - d, y). It has no
    match where the disparity is unknown, or where the partner lies outside columns 0..W - 1 of view 1.

    The ``cost`` of a match is the left-right difference |d - d1| in px, if the map of view 1 is given: d1 is its value
    at the pixel nearest to the partner. Both views see what is visible in both, so a large difference marks occluded
    and wrong points. The width W of the map, which no visible point can reach, stands in for d1 that is unknown, and is
    the largest cost.

    Matches are one-to-one: of the keypoints whose partners coincide, the one of lowest cost stays, of equal ones that
    of the largest disparity, which is the nearest surface, then the first. Coinciding keypoints have one match.

    Args:
        disparity: (H, W) map of view 0, x0 - x1 in px, float32 or float64; for B pairs (B, H, W), (B, 1, H, W), or a
            list of B maps (H_b, W_b). NaN, infinite and negative values are unknown.
        keypoints: (N, 2) float32 or float64, (x, y) in px of view 0, at most 1 px outside of the map.
        ptr: (B + 1,) int64 offsets of the pairs in ``keypoints``; None for one pair.
        disparity1: The maps of view 1, x0 - x1 in px at the pixels of view 1, in the same form and of the same sizes.
            None: the matches have no cost.

    Returns:
        The matches of all pairs in the order of the keypoints; ``cost`` (M,) is float32. No gradient: matches are
        constants, whatever the map and the keypoints are.

    Raises:
        ValueError: if shapes are others, there is not one map per pair, maps of both views differ in size, or a
            keypoint is NaN or farther outside than 1 px.
        TypeError: if maps or keypoints are not float32 or float64, or ``ptr`` is not int64.

    Example:
        >>> disparity = torch.full((4, 8), 2.0)
        >>> disparity[0] = torch.nan
        >>> keypoints = torch.tensor([[5.0, 1.0], [5.0, 0.0], [1.0, 3.0]])
        >>> matches = sample_disparity(disparity, keypoints, disparity1=torch.full((4, 8), 2.5))
        >>> matches.keypoints1, matches.cost  # one disparity is unknown, one partner lies outside
        (tensor([[3., 1.]]), tensor([0.5000]))
    """
    check_points("keypoints", keypoints)
    maps = _list_maps("disparity", disparity)
    if ptr is None:
        if len(maps) != 1:
            raise ValueError(f"ptr must be given for disparity of {len(maps)} pairs, got None")
        ptr = torch.tensor([0, len(keypoints)], device=keypoints.device)
    check_ptr("ptr", ptr, len(keypoints))
    maps1 = None if disparity1 is None else _list_maps("disparity1", disparity1)
    for name, given in (("disparity", maps), ("disparity1", maps1)):
        if given is not None and len(given) != len(ptr) - 1:
            raise ValueError(f"{name} must hold one map per pair ({len(ptr) - 1}), got {len(given)}")
    for b, (values, values1) in enumerate(zip(maps, maps1 or maps, strict=True)):
        if values.shape != values1.shape:
            sizes = f"{tuple(values1.shape)} and {tuple(values.shape)}"
            raise ValueError(f"disparity1 must have the size of disparity in every pair, got {sizes} in pair {b}")
    known = [[torch.where(values >= 0, values, torch.nan) for values in some] for some in (maps, maps1 or [])]
    return match_by_maps(keypoints, ptr, known[0], None if maps1 is None else known[1])


def match_by_maps(
    keypoints: Tensor, ptr: Tensor, disparity0: Sequence[Tensor], disparity1: Sequence[Tensor] | None
) -> Matches:
    """Matches as :func:`sample_disparity` describes them, where negative disparities are known too.

    Args:
        keypoints: (N, 2) px of view 0.
        ptr: (B + 1,) int64 offsets of the pairs.
        disparity0: B maps (H_b, W_b) of view 0; NaN and infinite values are unknown.
        disparity1: B maps of view 1 of the same sizes, or None for matches without cost.

    >>> maps = [torch.tensor([[-1.0, -1.0, -1.0]])]
    >>> match_by_maps(torch.tensor([[0.0, 0.0], [2.0, 0.0]]), torch.tensor([0, 2]), maps, None).keypoints1
    tensor([[1., 0.]])
    """
    disparity = sample_nearest(disparity0, keypoints, ptr).to(keypoints.dtype)  # (N,)
    sizes = [values.shape[1] for values in disparity0]
    width = torch.tensor(sizes, dtype=keypoints.dtype, device=keypoints.device)[ptr_to_batch(ptr)]
    x, y = keypoints.unbind(1)
    partner = x - disparity
    inside = (partner >= 0) & (partner <= width - 1)  # False for NaN and infinity
    matches = select_matches(Matches(keypoints, torch.stack([partner, y], 1), ptr), inside)
    disparity, width = disparity[inside], width[inside]
    cost = None
    if disparity1 is not None:
        other = sample_nearest(disparity1, matches.keypoints1, matches.ptr, name="partners")
        difference = (disparity - other).abs()
        cost = torch.where(difference < width, difference, width).float()  # NaN: width
    matches = Matches(matches.keypoints0, matches.keypoints1, matches.ptr, cost)
    return select_matches(matches, _one_to_one(matches, disparity))


def _one_to_one(matches: Matches, disparity: Tensor) -> Tensor:
    """(M,) bool, the cheapest match of every keypoint and partner; of equal ones the largest disparity, then row."""
    pair = pair_of(matches.ptr)
    ids0, ids1 = (
        coincident_ids(to_points(name, getattr(matches, name), matches.ptr), pair)
        for name in ("keypoints0", "keypoints1")
    )
    order = torch.argsort(disparity, descending=True, stable=True).numpy(force=True)
    cost = None if matches.cost is None else matches.cost.double().numpy(force=True)[order]
    kept = torch.zeros(len(order), dtype=torch.bool)
    kept[torch.from_numpy(order)] = torch.from_numpy(keep_one_to_one(ids0[order], ids1[order], cost))
    return kept.to(matches.keypoints0.device)


def _list_maps(name: str, maps: Maps) -> list[Tensor]:
    """The maps (H, W) of all pairs, one by one."""
    if not isinstance(maps, list | tuple):
        check_tensor(name, maps)
        batch = torch.as_tensor(maps)
        if batch.ndim == 4 and batch.shape[1] == 1:
            batch = batch[:, 0]
        if batch.ndim not in (2, 3):
            raise ValueError(f"{name} must have shape (H, W), (B, H, W) or (B, 1, H, W), got {tuple(batch.shape)}")
        maps = list(batch) if batch.ndim == 3 else [batch]
    for b, values in enumerate(maps):
        check_tensor(f"{name}[{b}]", values)
        if values.ndim != 2:
            raise ValueError(f"{name}[{b}] must have shape (H, W), got {tuple(values.shape)}")
        check_pixels(f"{name}[{b}]", values)
    return list(maps)
