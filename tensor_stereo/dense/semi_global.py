"""Semi-global matching: two rectified images -> disparity maps of both views -> the partners of keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.configs import MatchingConfig, SGBMConfig
from tensor_stereo.dense.partners import match_by_maps
from tensor_stereo.features.images import list_images, map_threads, to_gray
from tensor_stereo.types import Features, Matches

_MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "hh": cv2.STEREO_SGBM_MODE_HH,
}
_STEPS_PER_PX = 16  # OpenCV's unit of disparity
_NO_TEST = 1 << 20  # px of left-right disagreement that no two disparities have

Gray = NDArray[np.uint8]


class SemiGlobalMaps(NamedTuple):
    """Disparity maps of B pairs, x0 - x1 in px in steps of 1/16, NaN where unknown.

    Attributes:
        disparity0: B maps (H_b, W_b) float32, at the pixels of view 0.
        disparity1: B maps at the pixels of view 1; None without the left-right comparison.
    """

    disparity0: list[Tensor]
    disparity1: list[Tensor] | None


@torch.no_grad()
def match_semi_global(
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    config: SGBMConfig | None = None,
) -> SemiGlobalMaps:
    """Match the views of rectified pairs densely, by semi-global matching.

    Source: Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008, in
    OpenCV's variant ``cv2.StereoSGBM``: grey levels and their slopes are compared by absolute differences over a window
    (Birchfield & Tomasi 1998). OpenCV's own tests of uniqueness, speckles and left-right agreement are off, so that
    whatever judges the matches sees all of them, with the left-right difference as their cost.

    The map of view 1 is that of the mirrored images with the views exchanged. Both images are continued by their
    outermost columns, so that disparities at the borders are searched as elsewhere, and images smaller than the window
    or the range have maps too. No gradient.

    Args:
        images0: B images of view 0: (B, C, H, W), or a list of (C, H, W) of any sizes; (C, H, W) for one pair. C is 1
            or 3 (RGB), uint8 or floating point in [0, 1].
        images1: The images of view 1, of the same sizes.
        config: settings; None means the defaults.

    Returns:
        Maps on the device of the images. Those of a pair do not depend on the rest of the batch.

    Raises:
        ValueError: if the views of a pair differ in size, or images have another layout.
        TypeError: if images have another dtype.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> scene = torch.randint(0, 256, (1, 40, 90), generator=generator, dtype=torch.uint8)
        >>> maps = match_semi_global(scene[..., :80], scene[..., 7:87])  # view 1 shows all 7 px farther left
        >>> maps.disparity0[0][20, 20:24]
        tensor([7., 7., 7., 7.])
    """
    config = config or SGBMConfig()
    num_pairs = 1 if isinstance(images0, Tensor) and images0.ndim == 3 else len(images0)
    views0, views1 = (list_images(*view, num_pairs) for view in (("images0", images0), ("images1", images1)))
    tasks: list[tuple[Gray, Gray]] = []
    for b, (image0, image1) in enumerate(zip(views0, views1, strict=True)):
        if image0.shape[1:] != image1.shape[1:]:
            sizes = f"{tuple(image0.shape)} and {tuple(image1.shape)}"
            raise ValueError(f"images0 and images1 of pair {b} must be of one size, got {sizes}")
        left, right = (to_gray(image[None])[0, 0].numpy(force=True) for image in (image0, image1))
        tasks.append((left, right))
        if config.left_right:
            tasks.append((np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1])))
    found = map_threads(lambda task: _search(*task, config), tasks)
    step = 2 if config.left_right else 1
    maps0 = [_to_px(found[step * b], config, image.device) for b, image in enumerate(views0)]
    if not config.left_right:
        return SemiGlobalMaps(maps0, None)
    return SemiGlobalMaps(maps0, [_to_px(found[2 * b + 1][:, ::-1], config, v.device) for b, v in enumerate(views0)])


def match_keypoints(features0: Features, maps: SemiGlobalMaps, config: MatchingConfig | None = None) -> Matches:
    """Partners of the keypoints of view 0 in semi-global maps, as :func:`tensor_stereo.sample_disparity` reads them.

    Args:
        features0: keypoints of B images, view 0; nothing else of the features is used.
        maps: of these B pairs.
        config: its bounds of the disparity are kept; None means no bounds.

    Returns:
        One-to-one matches in the order of the keypoints, with the left-right difference in px as ``cost``. No gradient.

    Raises:
        ValueError: if there is not one map per image, or a keypoint lies farther outside of it than 1 px.
    """
    config = config or MatchingConfig()
    low = -torch.inf if config.min_disparity_px is None else config.min_disparity_px
    high = torch.inf if config.max_disparity_px is None else config.max_disparity_px
    gated = [torch.where((d >= low) & (d <= high), d, torch.nan) for d in maps.disparity0]
    return match_by_maps(features0.keypoints.detach(), features0.ptr, gated, maps.disparity1)


def _search(left: Gray, right: Gray, config: SGBMConfig) -> NDArray[np.int16]:
    """(H, W) disparity of the left image in sixteenths of a px; what is unknown lies below the least disparity."""
    area = config.window_px**2
    search = cv2.StereoSGBM.create(
        minDisparity=config.min_disparity_px,
        numDisparities=config.num_disparities_px,
        blockSize=config.window_px,
        P1=round(area * config.step_penalty_levels),
        P2=round(area * config.jump_penalty_levels),
        disp12MaxDiff=_NO_TEST,  # 0 and below, OpenCV tests for 1 px
        mode=_MODES[config.mode],
    )
    margin = config.window_px // 2 + 2  # what a window at the border reaches beyond it, with the slopes
    before = max(config.min_disparity_px + config.num_disparities_px, 0) + margin
    after = max(-config.min_disparity_px, 0) + margin
    padded = (cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right))
    found: NDArray[np.int16] = search.compute(*padded)
    return found[:, before : before + left.shape[1]]


def _to_px(found: NDArray[np.int16], config: SGBMConfig, device: torch.device) -> Tensor:
    """OpenCV's disparities as a map in px, NaN where there is none."""
    disparity = torch.from_numpy(np.divide(found, _STEPS_PER_PX, dtype=np.float32, order="C")).to(device)
    return torch.where(disparity >= config.min_disparity_px, disparity, torch.nan)
