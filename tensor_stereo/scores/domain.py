"""Marks what lies outside of the domain of a calibrated score: pairs in pixels, whose matches agree."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from enum import IntFlag

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.scores.alignment.form import Alignment, align_matches, epipolar_frames
from tensor_stereo.types import Matches

MAX_PX = 2.0**24  # beyond it float32 does not tell neighbouring pixels apart
_LEAST_SPAN_PX = 4.0  # of the keypoints of a pair; normalised coordinates span 1 or 2
_LEAST_MATCHES = 8  # fewer say nothing about their pair
_LEAST_TOLD = 32  # tested matches of a pair from which on a warning says that they do not agree; few seldom do
_SHARED = 3  # neighbours in both views that make a match one that agrees,
_LEAST_GROUP = 16  # in a group of at least so many: small ones are almost complete graphs, and agree by themselves
_MOST_SPREAD = 0.15  # of the directions of epipolar lines, one less the length of their mean
_MAX_ROW_SHIFT_PX = 0.75  # median of y0 - y1 over the matches that agree
_MAX_ROW_OFFSET_PX = 2.0  # median of |y0 - y1| over them; a rotated view has offsets of both signs


class Domain(IntFlag):
    """Why a pair lies outside of what a probability was calibrated on; several reasons may hold, 0 is inside.

    >>> Domain(0), Domain.SPAN | Domain.IMAGES
    (<Domain: 0>, <Domain.SPAN|IMAGES: 9>)
    """

    SPAN = 1  # the keypoints span less than 4 px, as normalised coordinates do
    AGREEMENT = 2  # fewer than 12 matches agree with their neighbours, so that no alignment is known
    ROWS = 4  # those that agree lie off their rows, or epipolar lines, in a way that nothing that all share explains
    IMAGES = 8  # more than a tenth of the keypoints of a view lie outside of its image
    EPIPOLE = 16  # epipolar lines meet among the keypoints, as where a camera moves forward; probabilities are too low


_SPAN, _AGREEMENT, _ROWS, _IMAGES, _EPIPOLE = map(int, Domain)  # a compiler knows no enumeration


class DomainWarning(UserWarning):
    """A score was asked for outside of what it was calibrated on."""


def describe_domain(mark: int) -> str:
    """The reasons of a mark in words, none for a pair inside of the domain.

    >>> describe_domain(Domain.AGREEMENT | Domain.IMAGES), describe_domain(0)
    ('agreement, images', '')
    """
    return ", ".join(reason.name.lower() for reason in Domain if reason & mark)  # type: ignore[union-attr]


def check_domain(
    matches: Matches, graphs: MatchGraphs, config: FilterConfig, alignment: Alignment | None = None
) -> Tensor:
    """Mark pairs whose keypoints are no pixels, or do not fit together; one warning of a kind for the whole batch.

    Pairs without matches have no mark. A pair of few matches is marked where fewer than 12 of them agree, as any pair
    is, but a warning says so only from 32 tested ones on. Where ``torch.compile`` traces, there are marks without
    warnings and errors.

    Args:
        matches: B pairs.
        graphs: The graphs of the same matches.
        alignment: What the score takes out; None: nothing, and agreement and rows are not looked at.
        config: Its score is ``consensus`` or ``learned``.

    Returns:
        (B,) int8, values of :class:`Domain`, all but ``IMAGES``. No gradient.

    Raises:
        ValueError: for coordinates beyond 2**24 px, where single precision has no whole pixels.

    Warns:
        DomainWarning: if a pair is marked.
    """
    with torch.no_grad():
        batch = ptr_to_batch(matches.ptr)
        small = _spans(matches, batch) < _LEAST_SPAN_PX
        off = few = told = meet = torch.zeros_like(small)
        if alignment is not None:
            off = _off_their_rows(align_matches(matches, alignment), graphs, batch, config) & alignment.has_rows
            off |= alignment.unfit
            if torch.compiler.is_compiling() or not bool(alignment.rectified.all()):
                spread = epipolar_frames(matches, alignment).spread
                meet = alignment.has_rows & ~alignment.rectified & (spread > _MOST_SPREAD)
            few = ~alignment.fitted & ~off & (matches.ptr.diff() > 0)
            told = few & (_count(graphs.group_size >= config.min_group_size, batch, matches) >= _LEAST_TOLD)
    if not torch.compiler.is_compiling():
        for name in ("keypoints0", "keypoints1"):
            _check_magnitude(name, getattr(matches, name), matches.ptr, batch)
        _warn(
            small,
            "the score expects keypoints in pixels, but those of {pairs} span less than "
            f"{_LEAST_SPAN_PX:g} px; multiply normalised coordinates by the size of the image",
        )
        of_views = off if alignment is None else off & ~alignment.rectified
        _warn(
            off & ~of_views,
            "the score expects rectified pairs, but the matches of {pairs} that agree with their neighbours lie off "
            "their rows; set rectified=False, or 'auto', which looks at every pair",
        )
        _warn(
            of_views,
            "the score expects that one map between the views, or one motion, explains most of the matches that agree "
            "with their neighbours, but those of {pairs} have none in common",
        )
        _warn(
            meet,
            "the score expects epipolar lines that meet far away, but those of {pairs} meet among the keypoints, as "
            "where a camera moves forward; its ranking holds, its probabilities are too low",
        )
        _warn(
            told,
            "the score expects matches that agree with their neighbours, but those of {pairs} hardly do, so their "
            "probabilities may be far off; check that row i of both views is one match",
        )
    marks = ((small, _SPAN), (few, _AGREEMENT), (off, _ROWS), (meet, _EPIPOLE))
    return torch.stack([holds.to(torch.int8) * mark for holds, mark in marks]).sum(0, dtype=torch.int8)


def check_images(matches: Matches, images: tuple[Sequence[Tensor], Sequence[Tensor]]) -> Tensor:
    """Mark pairs whose keypoints lie outside of their images, as they do if the images have been resized.

    Args:
        matches: B pairs.
        images: The B images (C, H, W) of view 0 and of view 1.

    Returns:
        (B,) int8, ``Domain.IMAGES`` or 0. No gradient.

    Warns:
        DomainWarning: if of some pair more than a tenth of the keypoints of a view lie outside.
    """
    outside = torch.zeros_like(matches.ptr[1:], dtype=torch.bool)
    batch = ptr_to_batch(matches.ptr)
    for points, view in zip((matches.keypoints0.detach(), matches.keypoints1.detach()), images, strict=True):
        size = points.new_tensor([[image.shape[-1], image.shape[-2]] for image in view]).reshape(-1, 2)
        beyond = ((points < -1) | (points > size.index_select(0, batch))).any(1)
        outside |= 10 * _count(beyond, batch, matches) > matches.ptr.diff()
    _warn(
        outside,
        "the score expects keypoints in pixels of the images, but many of {pairs} lie outside; give the images that "
        "the keypoints were found in",
    )
    return outside.to(torch.int8) * _IMAGES


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


def _off_their_rows(matches: Matches, graphs: MatchGraphs, batch: Tensor, config: FilterConfig) -> Tensor:
    """(B,) bool, whether most of those matches that share neighbours lie above, or below, or far from their rows."""
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
    return (total >= _LEAST_MATCHES) & (2 * most > total)


def _count(chosen: Tensor, batch: Tensor, matches: Matches) -> Tensor:
    """(B,) int64 matches of each pair that are chosen, of a (M,) mask."""
    return torch.zeros_like(matches.ptr[1:]).index_add_(0, batch, chosen.to(matches.ptr.dtype))


def _warn(pairs: Tensor, text: str) -> None:
    """One warning if a (B,) mask holds for a pair or several, named in the place of ``{pairs}``."""
    found = pairs.nonzero()[:, 0].tolist()
    if found:
        named = f"pair {found[0]}" if len(found) == 1 else f"{len(found)} of {len(pairs)} pairs"
        warnings.warn(text.format(pairs=named), DomainWarning, stacklevel=4)
