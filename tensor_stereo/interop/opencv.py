"""OpenCV's lists of KeyPoint and DMatch. Its keypoints, too, have pixel centres at integers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from tensor_stereo.types import Matches, check_mask, check_vector


def from_opencv(keypoints0: Sequence[Any], keypoints1: Sequence[Any], dmatches: Sequence[Any]) -> Matches:
    """The matches of one image pair.

    Args:
        keypoints0: list of ``cv2.KeyPoint`` of view 0, the query.
        keypoints1: list of ``cv2.KeyPoint`` of view 1, the train image.
        dmatches: list of ``cv2.DMatch``, the result of ``BFMatcher.match``; of the lists of ``knnMatch``, take one
            match per keypoint first.

    Returns:
        Matches of one pair on the CPU, float32, row by row those of ``dmatches``; cost is ``distance``. Join several
        with :func:`tensor_stereo.batching.collate_matches`.

    Raises:
        ValueError: if a DMatch names a keypoint that is not there.
        TypeError: if ``dmatches`` holds something else, such as the lists of ``knnMatch``.

    Example:
        >>> import cv2
        >>> points = cv2.KeyPoint_convert(np.array([[1.0, 2.0], [3.0, 4.0]], dtype=np.float32))
        >>> matches = from_opencv(points, points, [cv2.DMatch(0, 1, 0.5)])
        >>> matches.keypoints1, matches.cost
        (tensor([[3., 4.]]), tensor([0.5000]))
    """
    for k, match in enumerate(dmatches):
        if not isinstance(match, cv2.DMatch):
            raise TypeError(f"dmatches must be a flat list of cv2.DMatch, got {type(match).__name__} at {k}")
    points = []
    for name, keypoints, index in (
        ("keypoints0", keypoints0, [match.queryIdx for match in dmatches]),
        ("keypoints1", keypoints1, [match.trainIdx for match in dmatches]),
    ):
        if index and not 0 <= min(index) <= max(index) < len(keypoints):
            span = f"{min(index)}..{max(index)}"
            raise ValueError(f"dmatches must name rows 0..{len(keypoints) - 1} of {name}, got {span}")
        chosen = [keypoints[i].pt for i in index]
        points.append(torch.from_numpy(np.array(chosen, dtype=np.float32).reshape(-1, 2)))
    cost = torch.tensor([match.distance for match in dmatches], dtype=torch.float32)
    return Matches(points[0], points[1], torch.tensor([0, len(dmatches)]), cost)


def select_dmatches(dmatches: Sequence[Any], inlier: Tensor) -> list[Any]:
    """The ``cv2.DMatch`` that are inliers, in their order, for the same lists of keypoints.

    Args:
        dmatches: the list that :func:`from_opencv` was given.
        inlier: (M,) bool.

    Raises:
        ValueError: if ``inlier`` has another number of rows.
        TypeError: if ``inlier`` is not bool.

    Example:
        >>> dmatches = [cv2.DMatch(4, 0, 1), cv2.DMatch(7, 1, 1)]
        >>> [match.queryIdx for match in select_dmatches(dmatches, torch.tensor([False, True]))]
        [7]
    """
    check_vector("inlier", inlier, len(dmatches))
    check_mask("inlier", inlier)
    return [match for match, keep in zip(dmatches, inlier.tolist(), strict=True) if keep]


def to_opencv(matches: Matches, *, size_px: float = 1.0) -> tuple[list[Any], list[Any], list[Any]]:
    """Keypoints and matches of one pair as OpenCV draws them: ``cv2.drawMatches(image0, *, image1, *, ...)``.

    Args:
        matches: one pair.
        size_px: diameter of the keypoints, which Matches does not know.

    Returns:
        Keypoints of view 0, keypoints of view 1, and one ``cv2.DMatch`` per row whose ``distance`` is the cost, 0
        without cost. Coordinates become float32. No gradient.

    Raises:
        ValueError: if ``matches`` holds other than one pair.

    Example:
        >>> pair = Matches(torch.tensor([[5.0, 6.0]]), torch.tensor([[2.0, 6.0]]), torch.tensor([0, 1]))
        >>> keypoints0, keypoints1, dmatches = to_opencv(pair)
        >>> keypoints1[dmatches[0].trainIdx].pt
        (2.0, 6.0)
    """
    if matches.num_pairs != 1:
        raise ValueError(f"matches must hold one pair, got {matches.num_pairs}; split them with split_matches")
    views = [points.tolist() for points in (matches.keypoints0, matches.keypoints1)]
    keypoints0, keypoints1 = ([cv2.KeyPoint(x, y, size_px) for x, y in points] for points in views)
    cost = [0.0] * matches.num_matches if matches.cost is None else matches.cost.tolist()
    return keypoints0, keypoints1, [cv2.DMatch(k, k, distance) for k, distance in enumerate(cost)]
