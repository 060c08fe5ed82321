"""Ragged batches to and from padded tensors, lists and batch vectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor

from tensor_stereo.types import Features, Matches, check_ptr, check_rows


def lengths_to_ptr(lengths: Tensor) -> Tensor:
    """Offsets (B + 1,) int64 of consecutive runs with the given (B,) lengths.

    Example:
        >>> lengths_to_ptr(torch.tensor([2, 0, 3]))
        tensor([0, 2, 2, 5])
    """
    return torch.nn.functional.pad(lengths.to(torch.int64).cumsum(0), (1, 0))


def ptr_to_batch(ptr: Tensor) -> Tensor:
    """Pair index (M,) int64 of every row, as PyTorch Geometric's ``batch`` vector.

    Example:
        >>> ptr_to_batch(torch.tensor([0, 2, 2, 3]))
        tensor([0, 0, 2])
    """
    return torch.repeat_interleave(ptr.diff())


def batch_to_ptr(batch: Tensor, num_pairs: int | None = None) -> Tensor:
    """Offsets (B + 1,) int64 of a sorted batch vector (M,); ``num_pairs`` keeps empty pairs at the end.

    Raises:
        ValueError: if ``batch`` is not sorted, or names a pair outside ``num_pairs``.

    Example:
        >>> batch_to_ptr(torch.tensor([0, 0, 2]), num_pairs=4)
        tensor([0, 2, 2, 3, 3])
    """
    if bool((batch.diff() < 0).any()):
        raise ValueError("batch must be sorted, so that each pair's rows are contiguous")
    last = int(batch[-1]) if len(batch) else -1
    num_pairs = last + 1 if num_pairs is None else num_pairs
    if len(batch) and (int(batch[0]) < 0 or last >= num_pairs):
        raise ValueError(f"batch must name pairs 0..{num_pairs - 1}, got {int(batch[0])}..{last}")
    return lengths_to_ptr(torch.bincount(batch, minlength=num_pairs))


def to_padded(values: Tensor, ptr: Tensor, *, num_rows: int | None = None, fill: float = 0) -> tuple[Tensor, Tensor]:
    """Spread ragged rows over a padded tensor; gradients flow.

    Args:
        values: (M, ...) rows of all pairs.
        ptr: (B + 1,) int64 offsets.
        num_rows: N, at least the longest pair, which is the default.
        fill: value of the padding.

    Returns:
        padded (B, N, ...) and mask (B, N) bool, True for real rows.

    Example:
        >>> padded, mask = to_padded(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 1, 3]))
        >>> padded
        tensor([[1., 0.],
                [2., 3.]])
    """
    check_ptr("ptr", ptr, len(values))
    lengths = ptr.diff()
    longest = int(lengths.max()) if len(lengths) else 0
    num_rows = longest if num_rows is None else num_rows
    if num_rows < longest:
        raise ValueError(f"num_rows must be at least the longest pair ({longest}), got {num_rows}")
    mask = torch.arange(num_rows, device=values.device) < lengths[:, None]
    padded = values.new_full((*mask.shape, *values.shape[1:]), fill)
    return padded.masked_scatter(mask.reshape(*mask.shape, *[1] * (values.ndim - 1)), values), mask


def from_padded(padded: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Gather the real rows of a padded tensor; gradients flow. The inverse of :func:`to_padded`.

    Args:
        padded: (B, N, ...).
        mask: (B, N) bool, True for real rows, in any places; None means all.

    Returns:
        values (M, ...) and ptr (B + 1,) int64.

    Raises:
        ValueError: if ``mask`` has another shape.
        TypeError: if ``mask`` is not bool.

    Example:
        >>> from_padded(torch.tensor([[1.0, 0.0], [2.0, 3.0]]), torch.tensor([[True, False], [True, True]]))
        (tensor([1., 2., 3.]), tensor([0, 1, 3]))
    """
    if mask is None:
        mask = torch.ones(padded.shape[:2], dtype=torch.bool, device=padded.device)
    if mask.dtype != torch.bool:
        raise TypeError(f"mask must be bool, got {mask.dtype}")
    if mask.shape != padded.shape[:2]:
        raise ValueError(f"mask must have shape {tuple(padded.shape[:2])}, got {tuple(mask.shape)}")
    return padded[mask], lengths_to_ptr(mask.sum(1))


def split(values: Tensor, ptr: Tensor) -> list[Tensor]:
    """The rows of each pair, as views.

    Example:
        >>> split(torch.tensor([1, 2, 3]), torch.tensor([0, 1, 3]))
        [tensor([1]), tensor([2, 3])]
    """
    check_ptr("ptr", ptr, len(values))
    return list(torch.split(values, ptr.diff().tolist()))


def collate_matches(items: Sequence[Matches]) -> Matches:
    """Concatenate batches of matches into one; ``cost`` and ``group`` must be given by all or by none.

    Raises:
        ValueError: if some items lack ``cost`` or ``group``.

    Example:
        >>> one = Matches(torch.zeros(1, 2), torch.zeros(1, 2), torch.tensor([0, 1]))
        >>> collate_matches([one, one]).ptr
        tensor([0, 1, 2])
    """
    if not items:
        raise ValueError("items must hold at least one Matches, got an empty sequence")
    merged: dict[str, Tensor | None] = {}
    for name in (f.name for f in fields(Matches) if f.name != "ptr"):
        values = [getattr(item, name) for item in items]
        missing = [k for k, value in enumerate(values) if value is None]
        if missing and len(missing) < len(items):
            raise ValueError(f"{name} must be given by all items or by none; item {missing[0]} lacks it")
        merged[name] = None if missing else torch.cat(values)
    lengths = torch.cat([item.ptr.diff() for item in items])
    return Matches(ptr=lengths_to_ptr(lengths), **merged)  # type: ignore[arg-type]


def split_matches(matches: Matches) -> list[Matches]:
    """One :class:`Matches` per pair, as views; the inverse of :func:`collate_matches`."""
    return [select_pairs(matches, b, b + 1) for b in range(matches.num_pairs)]


def select_pairs(matches: Matches, start: int, stop: int) -> Matches:
    """The pairs ``start:stop`` of a batch, as views."""
    rows = slice(int(matches.ptr[start]), int(matches.ptr[stop]))
    return Matches(
        keypoints0=matches.keypoints0[rows],
        keypoints1=matches.keypoints1[rows],
        ptr=matches.ptr[start : stop + 1] - matches.ptr[start],
        cost=None if matches.cost is None else matches.cost[rows],
        group=None if matches.group is None else matches.group[rows],
    )


def select_matches(matches: Matches, mask: Tensor) -> Matches:
    """The matches at which ``mask`` (M,) bool is True; all pairs stay, some possibly empty."""
    check_rows("mask", mask, matches.num_matches)
    if mask.dtype != torch.bool:
        raise TypeError(f"mask must be bool, got {mask.dtype}")
    kept = torch.nn.functional.pad(mask.to(torch.int64).cumsum(0), (1, 0))
    return Matches(
        keypoints0=matches.keypoints0[mask],
        keypoints1=matches.keypoints1[mask],
        ptr=kept[matches.ptr],
        cost=None if matches.cost is None else matches.cost[mask],
        group=None if matches.group is None else matches.group[mask],
    )


def concatenate_features(items: Sequence[Features]) -> Features:
    """Join the images of several feature batches into one batch.

    Raises:
        ValueError: for an empty sequence, which has no descriptor length.
    """
    if not items:
        raise ValueError("items must hold at least one Features, got an empty sequence")
    return Features(
        keypoints=torch.cat([item.keypoints for item in items]),
        ptr=lengths_to_ptr(torch.cat([item.ptr.diff() for item in items])),
        descriptors=torch.cat([item.descriptors for item in items]),
        scores=torch.cat([item.scores for item in items]),
    )


def split_features(features: Features) -> list[Features]:
    """The images of a feature batch one by one, as views of the same memory.

    >>> features = Features(torch.zeros(3, 2), torch.tensor([0, 1, 3]), torch.zeros(3, 4), torch.arange(3.0))
    >>> [part.scores.tolist() for part in split_features(features)]
    [[0.0], [1.0, 2.0]]
    """
    columns = (features.keypoints, features.descriptors, features.scores)
    parts = zip(*(split(column, features.ptr) for column in columns), strict=True)
    return [
        Features(keypoints, features.ptr.new_tensor([0, len(keypoints)]), descriptors, scores)
        for keypoints, descriptors, scores in parts
    ]
