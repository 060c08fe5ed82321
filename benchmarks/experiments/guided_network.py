"""A small stereo network whose cost volume takes a hint at some pixels, and its errors against ground truth.

The hints are those of guided stereo matching: Poggi, Pallotti, Tosi & Mattoccia, CVPR 2019, section 3.2. The network is
a correlation of learned features with a correction by an hourglass of 2-D convolutions, and a soft argmin.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from tensor_stereo.features import to_gray

NUM_STEPS = 96  # of the cost volume, each 2 px of the full image
HEIGHT, SPREAD = 10.0, 1.0  # k and c of the paper: how much a hint raises its disparity, and how wide, in steps
_MULTIPLE = 8  # of which the sides of halved images must be


class GuidedStereoNet(nn.Module):
    """Disparities from two halved grey images and hints; 400 000 weights."""

    def __init__(self, feature_width: int = 24, width: int = 64) -> None:
        super().__init__()
        self.first = _conv(1, feature_width)
        self.second = _conv(feature_width, feature_width)
        self.third = _conv(feature_width, feature_width)
        self.down = nn.ModuleList(
            [_conv(NUM_STEPS + feature_width + 1, width, 2), _conv(width, width, 2), _conv(width, width, 2)]
        )
        self.inner = _conv(width, width)
        self.context = nn.ModuleList([_conv(width, width, dilation=n) for n in (1, 2, 4)])
        self.merge = _conv(2 * width, width)
        self.correction = nn.Conv2d(width, 4 * NUM_STEPS, 1)
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(15.0)))
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def forward(self, image0: Tensor, image1: Tensor, hints: Tensor) -> Tensor:
        """Disparity of view 0.

        Args:
            image0: (B, 1, H, W) grey levels of the halved view 0; H and W are multiples of 8.
            image1: of view 1.
            hints: (B, H, W) disparity in px of the full image, NaN where there is none.

        Returns:
            (B, H, W) px of the full image.
        """
        features0, features1 = self.describe(torch.cat([image0, image1])).chunk(2)
        volume = guide((1 + correlate(features0, features1, NUM_STEPS)) / 2, hints)
        there = hints.isfinite()[:, None].to(volume.dtype)
        half = functional.leaky_relu(self.down[0](torch.cat([volume, features0, there], 1)))
        half = half + functional.leaky_relu(self.inner(half))
        quarter = functional.leaky_relu(self.down[1](half))
        eighth = functional.leaky_relu(self.down[2](quarter))
        for layer in self.context:
            eighth = eighth + functional.leaky_relu(layer(eighth))
        quarter = quarter + _grow(eighth)
        merged = functional.leaky_relu(self.merge(torch.cat([half, _grow(quarter)], 1)))
        logits = self.log_sharpness.exp() * volume + functional.pixel_shuffle(self.correction(merged), 2)
        steps = torch.arange(NUM_STEPS, dtype=torch.float32, device=logits.device)
        return 2 * torch.einsum("bdhw,d->bhw", logits.float().softmax(1), steps)

    def describe(self, images: Tensor) -> Tensor:
        """Unit vectors (B, C, H, W)."""
        features = functional.leaky_relu(self.first(normalize_contrast(images)))
        features = features + functional.leaky_relu(self.second(features))
        return functional.normalize(self.third(features), dim=1)

    def predict(self, image0: Tensor, image1: Tensor, hints: Tensor | None = None) -> Tensor:
        """Disparity of a pair of any size.

        Args:
            image0: (C, H, W) of view 0.
            image1: of view 1.
            hints: (H, W) px, NaN where there is none; None: none at all.

        Returns:
            (H, W) px.
        """
        views = [halve(image)[None] for image in (image0, image1)]
        height, width = views[0].shape[2:]
        margin = (0, -width % _MULTIPLE, 0, -height % _MULTIPLE)
        given = torch.full(image0.shape[1:], torch.nan) if hints is None else hints
        halved = functional.pad(halve_hints(given[None]), margin, value=torch.nan)
        found = self(*(functional.pad(view, margin, mode="replicate") for view in views), halved)
        return double(found)[0, : image0.shape[1], : image0.shape[2]]


def guide(volume: Tensor, hints: Tensor) -> Tensor:
    """Raise every curve (B, D, H, W) of similarities >= 0 at its hint (B, H, W) in px, and lower the rest of it."""
    steps = torch.arange(volume.shape[1], dtype=torch.float32, device=volume.device)[:, None, None]
    bump = HEIGHT * (-((steps - hints[:, None] / 2) ** 2) / (2 * SPREAD**2)).exp()
    return volume * torch.where(hints.isfinite()[:, None], bump, 1.0).to(volume.dtype)


def correlate(features0: Tensor, features1: Tensor, num_steps: int) -> Tensor:
    """Cosine (B, D, H, W) of each pixel of view 0 and the pixel d columns to its left in view 1; 0 beyond the image."""
    rows0, rows1 = features0.permute(0, 2, 3, 1), features1.permute(0, 2, 1, 3)
    products = rows0 @ rows1  # (B, H, W, W), all pairs of one row
    x0 = torch.arange(features0.shape[3], device=features0.device)
    x1 = x0[:, None] - torch.arange(num_steps, device=features0.device)  # (W, D)
    volume = products.gather(3, x1.clamp(min=0).expand(*products.shape[:3], -1))
    return torch.where(x1 >= 0, volume, 0).permute(0, 3, 1, 2)


def normalize_contrast(images: Tensor) -> Tensor:
    """Grey levels (B, 1, H, W) -> zero mean and unit deviation in 9 x 9 px, down to 2 grey levels of deviation."""
    padded = functional.pad(images, (4, 4, 4, 4), mode="reflect")
    mean, square = functional.avg_pool2d(padded, 9, 1), functional.avg_pool2d(padded.square(), 9, 1)
    return (images - mean) / (square - mean.square()).clamp(min=4.0).sqrt()


def halve(image: Tensor) -> Tensor:
    """Image (C, H, W) -> grey levels (1, ceil H / 2, ceil W / 2) float32, the mean of 2 x 2 px."""
    gray = to_gray(image[None]).float()
    padded = functional.pad(gray, (0, gray.shape[3] % 2, 0, gray.shape[2] % 2), mode="replicate")
    return functional.avg_pool2d(padded, 2)[0]


def halve_hints(hints: Tensor) -> Tensor:
    """Hints (B, H, W) -> (B, ceil H / 2, ceil W / 2): the mean of those in 2 x 2 px, NaN without any."""
    padded = functional.pad(hints, (0, hints.shape[2] % 2, 0, hints.shape[1] % 2), value=torch.nan)
    known = padded.isfinite()
    total = functional.avg_pool2d(padded.nan_to_num(0)[:, None], 2)
    return (total / functional.avg_pool2d(known.float()[:, None], 2))[:, 0]  # 0 / 0 is NaN


def double(disparity: Tensor) -> Tensor:
    """Halved maps (B, H, W) at full size; the centre of halved pixel i lies at 2 i + 0.5."""
    return functional.interpolate(disparity[:, None], scale_factor=2, mode="bilinear", align_corners=False)[:, 0]


def _conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation)


def _grow(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
