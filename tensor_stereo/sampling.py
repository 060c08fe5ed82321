"""Values of maps at keypoints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.types import check_points, check_ptr


def sample_nearest(
    maps: Tensor | Sequence[Tensor], keypoints: Tensor, ptr: Tensor, *, name: str = "keypoints"
) -> Tensor:
    """Value of each pair's map at the nearest pixel of its keypoints.

    Coordinates are rounded half to even, as numpy and torch do. Sub-pixel keypoints may round to a pixel just outside;
    those within 1 px of the outermost pixel centres take the value at the border. No gradient.

    Args:
        maps: (B, H, W), or B tensors (H_b, W_b) of one dtype.
        keypoints: (M, 2) floating point, (x, y) in px.
        ptr: (B + 1,) int64 offsets of the pairs.
        name: what error messages call the keypoints.

    Returns:
        (M,) values in the dtype of ``maps``.

    Raises:
        ValueError: if there is not one two-dimensional map per pair, or a keypoint is NaN or farther outside than 1 px.

    Example:
        >>> depth = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
        >>> sample_nearest(depth, torch.tensor([[0.6, 0.2], [1.7, 1.0]]), torch.tensor([0, 2]))
        tensor([2., 4.])
    """
    check_points(name, keypoints)
    check_ptr("ptr", ptr, len(keypoints))
    if len(maps) != len(ptr) - 1:
        raise ValueError(f"there must be one map per pair ({len(ptr) - 1}), got {len(maps)}")
    for b, values in enumerate(maps):
        if values.ndim != 2:
            raise ValueError(f"map {b} must have shape (H, W), got {tuple(values.shape)}")
    if len(keypoints) == 0:
        return torch.zeros(0, dtype=maps[0].dtype if len(maps) else torch.float32, device=keypoints.device)
    flat = torch.cat([values.reshape(-1) for values in maps])
    shapes = torch.tensor([values.shape for values in maps], device=keypoints.device)  # (B, 2) height, width
    sizes = shapes.prod(1)
    pair = ptr_to_batch(ptr)
    limit = shapes.flip(1)[pair]  # (M, 2) width, height
    outside = ~((keypoints >= -1) & (keypoints <= limit)).all(1)
    if bool(outside.any()):
        row = int(outside.nonzero()[0, 0])
        raise ValueError(
            f"{name} must lie in their image, at most 1 px outside; row {row} is {keypoints[row].tolist()} "
            f"in an image of (width, height) {tuple(limit[row].tolist())}"
        )
    x, y = torch.minimum(keypoints.round().long().clamp(min=0), limit - 1).unbind(1)
    return flat[(sizes.cumsum(0) - sizes)[pair] + y * limit[:, 0] + x]
