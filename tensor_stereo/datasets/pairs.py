"""From the files of a pair to its tensors."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from tensor_stereo.datasets.files import Location, PairFiles, check_gt_scale, missing_scale
from tensor_stereo.datasets.images import (
    read_disparity_png,
    read_image,
    read_nonzero_mask,
    read_occlusion_mask,
    read_sintel_disparity,
    read_sintel_occlusion,
)
from tensor_stereo.datasets.pfm import FloatMap, read_pfm
from tensor_stereo.datasets.remote import fetched
from tensor_stereo.paths import has_ending
from tensor_stereo.types import StereoPair


def read_pair(files: PairFiles, *, gt_scale: float | None = None) -> StereoPair:
    """Read one pair.

    Of a grey view beside a view in colour, the one channel is repeated.

    Args:
        files: as found by :func:`~tensor_stereo.datasets.discovery.find_pairs`; those that are URLs of fsspec are
            copied to this machine for the time of reading.
        gt_scale: replaces ``files.gt_scale``: stored value / gt_scale = disparity in px.

    Returns:
        The pair on the CPU. ``disparity_gt`` is NaN where the release does not know it (0 in integer maps, infinite in
        float maps). The maps of FlyingThings3D's subset are negative in the left view; a map whose known values have a
        negative sum is negated. ``occluded`` comes from the release: its mask, or the pixels that KITTI's map of
        visible pixels leaves out; it is False where ground truth is unknown, and None for releases without it
        (Middlebury's but MiddEval3).

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is damaged, sizes differ, or no scale is known; the message names the files.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = [Path(folder, name) for name in ("view1.ppm", "view5.ppm", "disp1.pgm")]
    ...     for path, header in zip(paths, (b"P6 2 1 255 ", b"P6 2 1 255 ", b"P5 2 1 255 ")):
    ...         _ = path.write_bytes(header + bytes([0, 6, 0, 6, 0, 6]))
    ...     read_pair(PairFiles("middlebury-2005", "Art", *paths, gt_scale=3.0)).disparity_gt
    tensor([[nan, 2.]])
    """
    check_gt_scale(gt_scale)
    with fetched(files) as local:
        return _read_local(local, gt_scale)


def _read_local(files: PairFiles, gt_scale: float | None) -> StereoPair:
    """Read a pair whose files are paths."""
    image0, image1 = (read_image(path, sample_bits=files.sample_bits) for path in (files.image0, files.image1))
    channels = max(len(image0), len(image1))
    image0, image1 = (image.expand(channels, -1, -1).contiguous() for image in (image0, image1))
    if image0.shape != image1.shape:
        shapes = f"{files.image0} has {tuple(image0.shape)}, {files.image1} has {tuple(image1.shape)}"
        raise ValueError(f"both views of a rectified pair must have one shape (C, H, W): {shapes}")
    disparity = None if files.disparity_gt is None else _read_disparity(files, files.disparity_gt, gt_scale)
    occluded = None if disparity is None else _read_occluded(files, disparity, gt_scale)
    for path, values in ((files.disparity_gt, disparity), (files.mask or files.disparity_noc_gt, occluded)):
        if values is not None and values.shape != image0.shape[1:]:
            expected, given = tuple(image0.shape[1:]), values.shape
            raise ValueError(f"{path} must have the size (H, W) = {expected} of {files.image0}, got {given}")
    return StereoPair(
        name=files.scene,
        image0=image0,
        image1=image1,
        disparity_gt=None if disparity is None else torch.from_numpy(disparity),
        occluded=None if occluded is None else torch.from_numpy(occluded),
        dataset=files.dataset,
    )


class PairDataset(Dataset[StereoPair]):
    """Map-style data set over the files of pairs; each access reads from disk.

    A pair is named after its scene, or ``dataset/scene`` where several releases have a scene of that name. Pairs differ
    in size, so a ``DataLoader`` needs a ``collate_fn`` that does not stack, as ``list``.

    Args:
        files: in the order of the data set, as found by :func:`~tensor_stereo.datasets.discovery.find_pairs`.
        gt_scale: as in :func:`read_pair`, for every pair.

    >>> len(PairDataset([]))
    0
    """

    def __init__(self, files: Sequence[PairFiles], *, gt_scale: float | None = None) -> None:
        check_gt_scale(gt_scale)
        self.files = tuple(files)
        self.gt_scale = gt_scale
        scenes = Counter(pair.scene for pair in self.files)
        self.names = [f"{p.dataset}/{p.scene}" if scenes[p.scene] > 1 else p.scene for p in self.files]

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> StereoPair:
        k = operator.index(index)
        return replace(read_pair(self.files[k], gt_scale=self.gt_scale), name=self.names[k])


def _read_disparity(files: PairFiles, path: Location, gt_scale: float | None) -> FloatMap:
    """(H, W) float32 in px, NaN where unknown."""
    scale = files.gt_scale if gt_scale is None else gt_scale
    if files.gt_encoding == "sintel":
        return read_sintel_disparity(path)
    if not has_ending(Path(path), ".pfm"):
        if scale is None:
            raise missing_scale(files)
        return read_disparity_png(path, scale)
    stored = read_pfm(path)
    if stored.ndim != 2:
        raise ValueError(f"{path} must have one channel (Pf), got shape {stored.shape}")
    with np.errstate(all="ignore"):  # damaged files hold anything, signalling NaN among it
        disparity = stored / np.float32(1.0 if scale is None else scale)
    disparity[~np.isfinite(disparity)] = np.nan
    if files.gt_encoding == "flyingthings3d-subset" and np.nansum(disparity, dtype=np.float64) < 0:
        disparity = -disparity
    return disparity


def _read_occluded(files: PairFiles, disparity: FloatMap, gt_scale: float | None) -> NDArray[np.bool_] | None:
    """(H, W) bool from whatever the release tells of occlusion, None if it is silent."""
    if files.mask is not None and files.gt_encoding == "sintel":
        return read_sintel_occlusion(files.mask)
    if files.mask is not None and files.gt_encoding == "flyingthings3d-subset":
        return read_nonzero_mask(files.mask) & np.isfinite(disparity)
    if files.mask is not None:
        return read_occlusion_mask(files.mask)
    if files.disparity_noc_gt is None:
        return None
    visible = _read_disparity(files, files.disparity_noc_gt, gt_scale)
    if visible.shape != disparity.shape:
        sizes = f"{disparity.shape} of {files.disparity_gt}, got {visible.shape}"
        raise ValueError(f"{files.disparity_noc_gt} must have the size (H, W) = {sizes}")
    return np.isfinite(disparity) & np.isnan(visible)
