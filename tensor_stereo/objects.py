"""Restriction 3: matches are compared only with matches of the same object.

Source: Bustos, Vargas, Trujillo, "Classifying Estimated Stereo Correspondences Based on Delaunay Triangulation",
CIARP 2016, section 3. Otsu's threshold makes a binary image; its morphological closing minus its opening leaves the
places where thin structures begin and end, and the contours traced there stand for object boundaries.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import cv2
import numpy as np
import torch
from kornia.morphology import dilation, erosion
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import ObjectsConfig
from tensor_stereo.sampling import sample_nearest
from tensor_stereo.types import Matches, check_integer, check_ptr

_DEFAULT_CONFIG = ObjectsConfig()
_NUM_LEVELS = 256
_GROUP_STRIDE = 2**31  # labels are int32, so a pair of them fits one int64


def otsu_threshold(images: Tensor) -> Tensor:
    """Grey level that splits each image into the two classes of largest between-class variance.

    Foreground is what is strictly brighter. Of equally good levels the lowest is taken; a constant image gives 0, as in
    OpenCV. Counts are exact, so an image has the same threshold alone and in a batch. No gradient.

    Args:
        images: (B, 1, H, W) uint8.

    Returns:
        (B,) int64 grey levels 0..254.

    Raises:
        ValueError: if the shape is not (B, 1, H, W) or the images have no pixels.
        TypeError: if the dtype is not uint8.

    Source: Otsu, "A threshold selection method from gray-level histograms", 1979.

    Example:
        >>> otsu_threshold(torch.tensor([[[[10, 10, 200, 200]]]], dtype=torch.uint8))
        tensor([10])
    """
    _check_images("images", images)
    num_images = len(images)
    image_index = torch.arange(num_images, device=images.device).view(-1, 1, 1, 1)
    bins = images.long() + image_index * _NUM_LEVELS
    histogram = torch.bincount(bins.flatten(), minlength=num_images * _NUM_LEVELS).view(num_images, _NUM_LEVELS)
    levels = torch.arange(_NUM_LEVELS, device=images.device)
    weight0 = histogram.cumsum(1)  # (B, 256) pixels up to and including each level
    sum0 = (histogram * levels).cumsum(1)
    weight, total = weight0[:, -1:].double(), sum0[:, -1:].double()
    # w0 w1 (mu0 - mu1)^2 in units of pixels^2, from sums alone: equal splits get equal values
    product = weight0 * (weight - weight0)
    variance = (weight * sum0 - weight0 * total).square() / product.clamp(min=1)
    best = variance == variance.amax(1, keepdim=True)
    return torch.where(best, levels, _NUM_LEVELS).amin(1)


def contour_images(images: Tensor, config: ObjectsConfig = _DEFAULT_CONFIG) -> Tensor:
    """Closing minus opening of the Otsu-thresholded images, in which the object contours are traced.

    Both are taken of the binary image, with a flat square element; pixels outside the image are ignored. No gradient.

    Args:
        images: (B, 1, H, W) uint8.
        config: side of the element.

    Returns:
        (B, 1, H, W) bool.

    Raises:
        ValueError: if the shape is not (B, 1, H, W) or the element is not odd.
        TypeError: if the dtype is not uint8.

    Example:
        >>> image = torch.zeros(1, 1, 9, 9, dtype=torch.uint8)
        >>> image[..., 4, 4] = 255
        >>> contour_images(image).sum()  # too small for the element: closing keeps the dot, opening removes it
        tensor(1)
    """
    binary = (images > otsu_threshold(images).view(-1, 1, 1, 1)).float()
    # a square is a row after a column: 2 k instead of k * k shifts, the same values
    row = torch.ones(1, config.element_px, dtype=torch.float32, device=images.device)
    column = row.T
    closed = erosion(erosion(dilation(dilation(binary, row), column), row), column)
    opened = dilation(dilation(erosion(erosion(binary, row), column), row), column)
    return cast(Tensor, closed > opened)


def label_objects(images: Tensor, config: ObjectsConfig = _DEFAULT_CONFIG) -> Tensor:
    """Object of every pixel: the smallest contour that it lies in or on.

    All contours (outer ones and those of holes) that enclose at least ``min_area_px`` count. They are numbered from the
    largest area to the smallest, ties from top to bottom, then left to right, so a pixel's label is the highest number
    among the contours around it. A constant image has no contour. The labels of an image are the same alone and in a
    batch. No gradient.

    Args:
        images: (B, 1, H, W) uint8; any size down to one pixel, B may be 0.
        config: element and least area.

    Returns:
        (B, H, W) int32 labels 1..K of each image, 0 where no contour encloses the pixel, on the device of ``images``.

    Raises:
        ValueError: if the shape is not (B, 1, H, W), the element is not odd or the area is negative.
        TypeError: if the dtype is not uint8.

    Source: Restriction 3 of the paper, section 3.

    Example:
        >>> image = torch.zeros(1, 1, 40, 40, dtype=torch.uint8)
        >>> image[..., 10:30, 10:30] = 255
        >>> image[..., 13:27, 13:27] = 0  # a frame 3 px wide
        >>> label_objects(image)[0, [0, 10, 20], [0, 10, 20]]  # outside, on the frame, in it
        tensor([0, 1, 2], dtype=torch.int32)
    """
    outlines = contour_images(images, config)
    num_images, _, height, width = images.shape
    labels = np.zeros((num_images, height, width), np.int32)

    def label(b: int) -> None:
        for number, contour in enumerate(_trace(outlines[b, 0], config), start=1):
            cv2.drawContours(labels[b], [contour], 0, number, cv2.FILLED)

    if num_images == 1:
        label(0)
    elif num_images:
        with ThreadPoolExecutor(min(num_images, torch.get_num_threads())) as pool:
            list(pool.map(label, range(num_images)))
    return torch.from_numpy(labels).to(images.device)


def trace_objects(image: Tensor, config: ObjectsConfig = _DEFAULT_CONFIG) -> list[Tensor]:
    """Contours of one image; the one at index k - 1 bounds the object that :func:`label_objects` calls k.

    Args:
        image: (1, H, W) uint8.
        config: element and least area.

    Returns:
        One (L, 2) int32 closed chain of 8-connected pixels, (x, y), per contour, on the CPU; largest area first.

    Raises:
        ValueError: if the shape is not (1, H, W), the element is not odd or the area is negative.
        TypeError: if the dtype is not uint8.

    Example:
        >>> trace_objects(torch.zeros(1, 20, 20, dtype=torch.uint8))
        []
    """
    if image.ndim != 3:
        raise ValueError(f"image must have shape (1, H, W), got {tuple(image.shape)}")
    outline = contour_images(image[None], config)[0, 0]
    return [torch.from_numpy(contour[:, 0]) for contour in _trace(outline, config)]


def group_matches(matches: Matches, labels0: Tensor | Sequence[Tensor], labels1: Tensor | Sequence[Tensor]) -> Tensor:
    """Group of every match: the pair (object in view 0, object in view 1).

    A wrong match across objects falls into a small group of its own instead of spoiling its neighbours. Two matches of
    one stereo pair have the same number iff both objects agree; :func:`split_group` takes it apart. No gradient.

    Args:
        matches: M matches of B pairs.
        labels0: (B, H, W) integers, or B maps (H_b, W_b) where sizes differ; not negative, below 2**31.
        labels1: the same of view 1.

    Returns:
        (M,) int64, for ``Matches.group``.

    Raises:
        ValueError: if there is not one map per pair, a label is negative, or a keypoint lies more than 1 px outside its
            image.
        TypeError: if the labels are no integers.

    Source: Restriction 3 of the paper, section 3.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
        >>> matches = Matches(points, points, ptr=torch.tensor([0, 2]))
        >>> labels = torch.tensor([[[0, 3]]])
        >>> split_group(group_matches(matches, labels, labels))
        (tensor([0, 3]), tensor([0, 3]))
    """
    objects = []
    for view, labels, keypoints in ((0, labels0, matches.keypoints0), (1, labels1, matches.keypoints1)):
        for label_map in labels:
            check_integer(f"labels{view}", label_map)
        found = sample_nearest(labels, keypoints, matches.ptr, name=f"keypoints{view}").long()
        if bool(((found < 0) | (found >= _GROUP_STRIDE)).any()):
            raise ValueError(f"labels{view} must lie in 0..2**31 - 1, got {int(found.min())}..{int(found.max())}")
        objects.append(found)
    return objects[0] * _GROUP_STRIDE + objects[1]


def split_group(group: Tensor) -> tuple[Tensor, Tensor]:
    """Objects in view 0 and in view 1 of the groups that :func:`group_matches` made.

    Args:
        group: (M,) int64.

    Returns:
        Two (M,) int64 label vectors; 0 is the background.

    Example:
        >>> split_group(torch.tensor([5 * 2**31 + 7]))
        (tensor([5]), tensor([7]))
    """
    return group // _GROUP_STRIDE, group % _GROUP_STRIDE


def isolated_matches(group: Tensor, ptr: Tensor) -> Tensor:
    """Matches that join two objects which no other match joins.

    The paper compares matches "only if they belong to the same 3D object". Two contours that a single match joins have
    nothing else in common that could show them to be one object. The background (label 0) is no object, so matches that
    touch it are never isolated. Count the answer with :func:`tensor_stereo.evaluation.metrics.isolated_update`.

    Args:
        group: (M,) int64 from :func:`group_matches`.
        ptr: (B + 1,) int64 offsets of the pairs.

    Returns:
        (M,) bool.

    Raises:
        ValueError: if ``ptr`` does not fit ``group``.

    Example:
        >>> stride = 2**31
        >>> group = torch.tensor([stride + 1, stride + 1, stride + 2, 2])  # objects 1-1 twice, 1-2, background-2
        >>> isolated_matches(group, torch.tensor([0, 4]))
        tensor([False, False,  True, False])
    """
    check_integer("group", group)
    check_ptr("ptr", ptr, len(group))
    joined = torch.stack([ptr_to_batch(ptr), group], 1)
    _, joint, num_joining = torch.unique(joined, dim=0, return_inverse=True, return_counts=True)
    object0, object1 = split_group(group)
    alone: Tensor = num_joining[joint] == 1
    return alone & (object0 > 0) & (object1 > 0)


def _trace(outline: Tensor, config: ObjectsConfig) -> list[NDArray[np.int32]]:
    """Contours (L, 1, 2) of at least the least area in a (H, W) boolean image, in the order of their labels."""
    image = outline.to("cpu", torch.uint8).numpy()
    contours, _ = cv2.findContours(image, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    areas = [cv2.contourArea(contour) for contour in contours]
    kept = [(area, contour) for area, contour in zip(areas, contours, strict=True) if area >= config.min_area_px]

    def order(item: tuple[float, NDArray[np.int32]]) -> tuple[Any, ...]:
        area, contour = item
        x, y = contour[:, 0].T
        top_left = int((y.astype(np.int64) * image.shape[1] + x).min())
        return -area, top_left, len(contour)

    return [contour for _, contour in sorted(kept, key=order)]


def _check_images(name: str, images: Tensor) -> None:
    if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape[1:]:
        raise ValueError(f"{name} must have shape (B, 1, H, W) with H, W >= 1, got {tuple(images.shape)}")
    if images.dtype != torch.uint8:
        raise TypeError(f"{name} must be uint8 grey levels, got {images.dtype}")
