"""SIFT keypoints and descriptors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import torch
from kornia.feature import SIFTFeatureScaleSpace, get_laf_center, get_laf_scale, laf_is_filled
from torch import Tensor, nn

from tensor_stereo.configs import SIFTConfig
from tensor_stereo.features.images import join_images, map_images, strongest_first, to_gray
from tensor_stereo.features.tiles import ScaledFeatures, detect_in_tiles
from tensor_stereo.types import Features

_SIZE = 128  # 4 x 4 cells of 8 directions
_LAF_PER_SIGMA = 6  # kornia's frames are so many times as large as the scale of detection
_OPENCV_NORM = 512  # OpenCV scales the unit vector by this and rounds it to whole numbers 0..255


def detect_sift(images: Tensor, config: SIFTConfig | None = None) -> Features:
    """Detect extrema of the difference of Gaussians and describe them by histograms of gradients.

    Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004. ``backend="kornia"``
    is its ``SIFTFeatureScaleSpace`` with descriptors from the detector's own pyramid: the ``max_keypoints`` extrema
    of largest contrast, no threshold on contrast or edges, one orientation each. ``backend="opencv"`` is ``cv2.SIFT``
    with both thresholds, up to several orientations (hence keypoints) in one place, and the precise upscaling without
    which its coordinates are off by a quarter of a pixel. Both refine positions below the pixel, in the same frame,
    pixel centres at integers.

    Descriptors are plain SIFT, not RootSIFT, in OpenCV's order of cells and directions from either backend.
    ``upright=True`` skips the orientation: in the eight scenes of the paper it gives 11 % more matches (kornia, ratio
    0.8), and a share of correct ones that is 1.3 percentage points lower. The default is Lowe's method.

    Images of more than 4 megapixels are detected in tiles and, for keypoints of scale 7.2 px and more, at half
    their size (:func:`tensor_stereo.features.tiles.detect_in_tiles`), so that memory stays
    below 2 GB up to 40 megapixels.

    Images are detected one by one: kornia's operators choose another order of summation for a batch. With kornia, the
    bits (not the result to single precision) also depend on ``torch.get_num_threads()``. No gradient.

    Args:
        images: (B, 1, H, W) or (B, 3, H, W), uint8 or floating point in [0, 1], as :func:`to_gray` takes them.
        config: settings; None means the defaults.

    Returns:
        Sub-pixel keypoints, strongest first, equal scores by row, then column; (N, 128) descriptors of unit length
        (opencv: whole multiples of 1/512, of unit length up to that rounding, so that their squared distances are
        exact in float32); ``scores`` is the contrast, |difference of Gaussians| of the image in [0, 1], with the
        backend's own factor. An image without texture or with a side below about 6 px has no keypoints.

    Raises:
        ValueError: if ``images`` has another shape, or values outside of [0, 1].
        TypeError: if ``images`` has another dtype.

    >>> y, x = torch.meshgrid(torch.arange(64.0), torch.arange(80.0), indexing="ij")
    >>> blob = torch.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 18)
    >>> detect_sift(blob[None, None]).keypoints[0].round(decimals=2).tolist()
    [40.0, 30.0]
    """
    config = config or SIFTConfig()
    gray = to_gray(images)
    if config.backend == "opencv":
        detect, workers, gray = partial(_detect_opencv, config=config), None, gray.cpu()
    else:
        module = SIFTFeatureScaleSpace(
            min(config.max_keypoints, 4 * gray.shape[-2] * gray.shape[-1]),  # it makes room for so many
            upright=config.upright,
            rootsift=False,
            device=gray.device,
            descriptor_backend="pyramid",
            descriptor_layout="opencv",
        )
        # kornia's operators bring threads of their own; a second image fills the gaps between them
        detect, workers = partial(_detect_kornia, module=module), 2
    detected = map_images(lambda image: _strongest(image, detect, config), gray, max_workers=workers)
    (keypoints, descriptors, scores), ptr = join_images(detected, [(2,), (_SIZE,), ()], images.device)
    return Features(keypoints, ptr, descriptors, scores)


def _strongest(
    image: Tensor, detect: Callable[[Tensor], ScaledFeatures], config: SIFTConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Keypoints (N, 2), descriptors (N, 128), scores (N,) of one (H, W) image."""
    keypoints, descriptors, scores, _ = detect_in_tiles(detect, image)
    order = strongest_first(keypoints, scores, config.max_keypoints)
    return keypoints[order], descriptors[order], scores[order]


@torch.no_grad()
def _detect_kornia(image: Tensor, module: nn.Module) -> ScaledFeatures:
    lafs, responses, descriptors = module(image[None, None] / 255)
    filled = laf_is_filled(lafs)  # the other slots are padding
    sigma = get_laf_scale(lafs)[..., 0, 0] / _LAF_PER_SIGMA
    return ScaledFeatures(get_laf_center(lafs)[filled], descriptors[filled], responses[filled], sigma[filled])


def _detect_opencv(image: Tensor, config: SIFTConfig) -> ScaledFeatures:
    levels = image.round().to(torch.uint8).numpy()
    sift = cv2.SIFT.create(config.max_keypoints, enable_precise_upscale=True)
    if config.upright:
        places = {(*k.pt, k.size): k for k in sift.detect(levels)}  # one keypoint for all orientations
        for keypoint in places.values():
            keypoint.angle = 0
        # without keypoints, OpenCV's compute() raises for images of some sizes
        found, vectors = sift.compute(levels, list(places.values())) if places else ([], None)
    else:
        found, vectors = sift.detectAndCompute(levels, None)
    if not found:
        nothing = torch.zeros(0, dtype=torch.float32)
        return ScaledFeatures(nothing.reshape(0, 2), nothing.reshape(0, _SIZE), nothing, nothing)
    keypoints = torch.from_numpy(cv2.KeyPoint.convert(found))
    scores, size = torch.tensor([(k.response, k.size) for k in found], dtype=torch.float32).unbind(1)
    return ScaledFeatures(keypoints, torch.from_numpy(vectors) / _OPENCV_NORM, scores, size / 2)
