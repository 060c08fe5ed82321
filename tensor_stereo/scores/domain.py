"""Marks what lies outside of the domain of a calibrated score: rectified pairs, in pixels."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.scores.alignment import Alignment, align_matches
from tensor_stereo.types import Matches

MAX_PX = 2.0**24  # beyond it float32 does not tell neighbouring pixels apart
_LEAST_SPAN_PX = 4.0  # of the keypoints of a pair; normalised coordinates span 1 or 2
_LEAST_MATCHES = 8  # fewer say nothing about their pair
_SHARED = 3  # neighbours in both views that make a match one that agrees,
_LEAST_GROUP = 16  # in a group of at least so many: small ones are almost complete graphs, and agree by themselves
_MAX_ROW_SHIFT_PX = 0.75  # median of y0 - y1 over the matches that agree
_MAX_ROW_OFFSET_PX = 2.0  # median of |y0 - y1| over them; a rotated view has offsets of both signs


class DomainWarning(UserWarning):
    """A score was asked for outside of what it was calibrated on."""


def check_domain(
    matches: Matches, graphs: MatchGraphs, config: FilterConfig, alignment: Alignment | None = None
) -> None:
    """Raise or warn where keypoints are no pixels of rectified pairs; one warning of a kind for the whole batch.

    Args:
        matches: B pairs.
        graphs: The graphs of the same matches.
        alignment: What the score takes out of the rows of rectified pairs; None: nothing.
        config: Its score is ``consensus`` or ``learned``; ``consensus`` can be set for pairs that are not rectified.

    Raises:
        ValueError: for coordinates beyond 2**24 px, where single precision has no whole pixels.

    Warns:
        DomainWarning: if the keypoints of a pair span less than 4 px, or the matches that agree with their neighbours
            lie off their rows.
    """
    if torch.compiler.is_compiling() or not matches.num_matches:
        return
    with torch.no_grad():
        batch = ptr_to_batch(matches.ptr)
        for name in ("keypoints0", "keypoints1"):
            _check_magnitude(name, getattr(matches, name), matches.ptr, batch)
        small = (_spans(matches, batch) < _LEAST_SPAN_PX).nonzero()[:, 0].tolist()
        is_rectified = config.resolved_score == "learned" or config.consensus.rectified
        aligned = matches if alignment is None else align_matches(matches, alignment)
        off = _pairs_off_their_rows(aligned, graphs, batch, config) if is_rectified else []
    if small:
        message = (
            f"the score expects keypoints in pixels, but those of {_count(small, matches)} span less than "
            f"{_LEAST_SPAN_PX:g} px; multiply normalised coordinates by the size of the image"
        )
        warnings.warn(message, DomainWarning, stacklevel=3)
    if off:
        message = (
            f"the score expects rectified pairs, but the matches of {_count(off, matches)} that agree with their "
            "neighbours lie off their rows; rectify, or set the score 'consensus' with consensus=UNRECTIFIED, or the "
            "verdict 'cardinality'"
        )
        warnings.warn(message, DomainWarning, stacklevel=3)


def check_images(matches: Matches, images: tuple[Sequence[Tensor], Sequence[Tensor]]) -> None:
    """Warn where keypoints lie outside of their images, as they do if the images have been resized.

    Args:
        matches: B pairs.
        images: The B images (C, H, W) of view 0 and of view 1.

    Warns:
        DomainWarning: if of some pair more than a tenth of the keypoints of a view lie outside.
    """
    outside: list[int] = []
    batch = ptr_to_batch(matches.ptr)
    for name, view in (("keypoints0", images[0]), ("keypoints1", images[1])):
        points = getattr(matches, name).detach()
        size = points.new_tensor([[image.shape[-1], image.shape[-2]] for image in view]).reshape(-1, 2)
        beyond = ((points < -1) | (points > size.index_select(0, batch))).any(1)
        count = torch.zeros_like(matches.ptr[:-1]).index_add_(0, batch, beyond.to(matches.ptr.dtype))
        outside += (10 * count > matches.ptr.diff()).nonzero()[:, 0].tolist()
    if outside:
        message = (
            f"the score expects keypoints in pixels of the images, but many of {_count(sorted(set(outside)), matches)} "
            "lie outside; give the images that the keypoints were found in"
        )
        warnings.warn(message, DomainWarning, stacklevel=3)


def _check_magnitude(name: str, keypoints: Tensor, ptr: Tensor, batch: Tensor) -> None:
    far = (keypoints.abs() > MAX_PX).any(1)
    if bool(far.any()):
        row = int(far.int().argmax())
        pair = int(batch[row])
        where = f"row {row - int(ptr[pair])} of pair {pair}"
        given = tuple(keypoints[row].tolist())
        raise ValueError(f"{name} must be pixels, at most {MAX_PX:.0f} in magnitude, got {given} in {where}")


def _spans(matches: Matches, batch: Tensor) -> Tensor:
    """(B,) larger side of the box around the keypoints of either view; infinite in pairs of few matches."""
    points = torch.cat([matches.keypoints0, matches.keypoints1], 1).detach().double()
    at = batch[:, None].expand_as(points)
    low, high = (points.new_full((matches.num_pairs, 4), sign * torch.inf) for sign in (1, -1))
    low, high = low.scatter_reduce(0, at, points, "amin"), high.scatter_reduce(0, at, points, "amax")
    return torch.where(matches.ptr.diff() >= _LEAST_MATCHES, (high - low).amax(1), torch.inf)


def _pairs_off_their_rows(matches: Matches, graphs: MatchGraphs, batch: Tensor, config: FilterConfig) -> list[int]:
    """Pairs with so many matches that share neighbours, most of which lie above, or below, or far from their rows."""
    overlap = shared_neighbors(graphs.adjacency0, graphs.adjacency1, backend=config.backend).overlap
    agrees = (overlap >= _SHARED) & (graphs.group_size >= _LEAST_GROUP)
    shift = matches.keypoints0[:, 1] - matches.keypoints1[:, 1]
    conditions = (
        agrees,
        agrees & (shift >= _MAX_ROW_SHIFT_PX),
        agrees & (shift <= -_MAX_ROW_SHIFT_PX),
        agrees & (shift.abs() >= _MAX_ROW_OFFSET_PX),
    )
    rows = torch.stack(conditions, 1).to(matches.ptr.dtype)
    counts = rows.new_zeros(matches.num_pairs, len(conditions)).index_add_(0, batch, rows)
    total, most = counts[:, 0], counts[:, 1:].amax(1)
    return ((total >= _LEAST_MATCHES) & (2 * most > total)).nonzero()[:, 0].tolist()


def _count(pairs: list[int], matches: Matches) -> str:
    return f"pair {pairs[0]}" if len(pairs) == 1 else f"{len(pairs)} of {matches.num_pairs} pairs"
