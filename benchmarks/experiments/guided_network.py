"""A small stereo network whose cost volume takes a hint at some pixels.

The hints are those of guided stereo matching: Poggi, Pallotti, Tosi & Mattoccia, CVPR 2019, section 3.2. The network is
a correlation of learned features at a quarter of the size with a correction by an hourglass of 2-D convolutions, a soft
argmin, and a learned upsampling (Teed & Deng, ECCV 2020, section 3.3). At a quarter of the size, since matches are few:
the half percent of the pixels that have one are 7 % of its cells, at half size 2 %, of which the same network took no
notice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from tensor_stereo.features import to_gray

SIZE = 4  # px of the image per cell
NUM_STEPS = 48  # of the cost volume, each SIZE px
HEIGHT, SPREAD = 10.0, 1.0  # k and c of the paper: how much a hint raises its disparity, and how wide, in steps
_MULTIPLE = 16  # px, of which the sides of images must be


class GuidedStereoNet(nn.Module):
    """Disparities from two grey images and hints; 392 000 weights."""

    def __init__(self, feature_width: int = 32, width: int = 64) -> None:
        super().__init__()
        self.shrink = nn.ModuleList([_conv(1, feature_width, 2), _conv(feature_width, feature_width, 2)])
        self.deepen = nn.ModuleList([_conv(feature_width, feature_width, dilation=n) for n in (1, 2)])
        self.describe_last = _conv(feature_width, feature_width)
        self.enter = _conv(NUM_STEPS + feature_width + 1, width)
        self.inner = _conv(width, width)
        self.down = nn.ModuleList([_conv(width, width, 2), _conv(width, width, 2)])
        self.context = nn.ModuleList([_conv(width, width, dilation=n) for n in (1, 2, 4)])
        self.merge = _conv(2 * width, width)
        self.correction = nn.Conv2d(width, NUM_STEPS, 1)
        self.blend = nn.Conv2d(width, 9 * SIZE**2, 1)
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(15.0)))
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def forward(self, image0: Tensor, image1: Tensor, hints: Tensor) -> Tensor:
        """Disparity of view 0.

        Args:
            image0: (B, 1, H, W) grey levels of view 0; H and W are multiples of 16.
            image1: of view 1.
            hints: (B, H, W) px, NaN where there is none.

        Returns:
            (B, H, W) px.
        """
        return self.decide(*self.compare(image0, image1), hints)

    def compare(self, image0: Tensor, image1: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, C, H / 4, W / 4) of view 0, and similarities (B, D, H / 4, W / 4) in [0, 1]."""
        features0, features1 = self.describe(torch.cat([image0, image1])).chunk(2)
        return features0, (1 + correlate(features0, features1, NUM_STEPS)) / 2

    def decide(self, features0: Tensor, similarity: Tensor, hints: Tensor) -> Tensor:
        """The disparity of what :meth:`compare` found, with hints."""
        cells = shrink_hints(hints)
        volume = guide(similarity, cells)
        there = cells.isfinite()[:, None].to(volume.dtype)
        whole = functional.leaky_relu(self.enter(torch.cat([volume, features0, there], 1)))
        whole = whole + functional.leaky_relu(self.inner(whole))
        half = functional.leaky_relu(self.down[0](whole))
        quarter = functional.leaky_relu(self.down[1](half))
        for layer in self.context:
            quarter = quarter + functional.leaky_relu(layer(quarter))
        wide = _grow(half + _grow(quarter))
        merged = functional.leaky_relu(self.merge(torch.cat([whole, wide], 1)))
        logits = self.log_sharpness.exp() * volume + self.correction(merged)
        steps = torch.arange(NUM_STEPS, dtype=torch.float32, device=logits.device)
        disparity = SIZE * torch.einsum("bdhw,d->bhw", logits.float().softmax(1), steps)
        return blend(disparity, self.blend(merged).float())

    def describe(self, images: Tensor) -> Tensor:
        """Unit vectors (B, C, H / 4, W / 4)."""
        features = normalize_contrast(images)
        for layer in self.shrink:
            features = functional.leaky_relu(layer(features))
        for layer in self.deepen:
            features = features + functional.leaky_relu(layer(features))
        return functional.normalize(self.describe_last(features), dim=1)

    @torch.no_grad()
    def predict(self, image0: Tensor, image1: Tensor, hints: Iterable[Tensor | None] = (None,)) -> Iterator[Tensor]:
        """Disparities of a pair of any size, one for each set of hints.

        Args:
            image0: (C, H, W) of view 0.
            image1: of view 1.
            hints: each (H, W) px, NaN where there is none; None: none at all.

        Yields:
            (H, W) px.
        """
        height, width = image0.shape[1:]
        margin = (0, -width % _MULTIPLE, 0, -height % _MULTIPLE)
        views = [to_gray(image[None]).float() for image in (image0, image1)]
        found = self.compare(*(functional.pad(view, margin, mode="replicate") for view in views))
        for some in hints:
            given = torch.full((height, width), torch.nan) if some is None else some
            yield self.decide(*found, functional.pad(given[None], margin, value=torch.nan))[0, :height, :width]


def guide(volume: Tensor, cells: Tensor) -> Tensor:
    """Raise every curve (B, D, H, W) of similarities >= 0 at the hint (B, H, W) in px, and lower the rest of it."""
    steps = torch.arange(volume.shape[1], dtype=torch.float32, device=volume.device)[:, None, None]
    bump = HEIGHT * (-((steps - cells[:, None] / SIZE) ** 2) / (2 * SPREAD**2)).exp()
    return volume * torch.where(cells.isfinite()[:, None], bump, 1.0).to(volume.dtype)


def correlate(features0: Tensor, features1: Tensor, num_steps: int) -> Tensor:
    """Cosine (B, D, H, W) of each cell of view 0 and the one d columns to its left in view 1; 0 beyond the image."""
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


def shrink_hints(hints: Tensor) -> Tensor:
    """Hints (B, H, W) -> (B, H / 4, W / 4): the largest one of each cell, NaN without any.

    The largest, since what is near hides what is far; a mean of both would be right of neither.
    """
    known = hints.nan_to_num(-1)[:, None]
    largest = functional.max_pool2d(known, SIZE)[:, 0]
    return torch.where(largest >= 0, largest, torch.nan)


def blend(disparity: Tensor, logits: Tensor) -> Tensor:
    """Cells (B, H, W) at full size: every pixel is a mean of 3 x 3 cells, with weights from (B, 9 * 16, H, W)."""
    b, height, width = disparity.shape
    weight = logits.view(b, 9, SIZE, SIZE, height, width).softmax(1)
    around = functional.unfold(functional.pad(disparity[:, None], (1, 1, 1, 1), mode="replicate"), 3)
    around = around.view(b, 9, 1, 1, height, width)
    return (weight * around).sum(1).permute(0, 3, 1, 4, 2).reshape(b, SIZE * height, SIZE * width)


def _conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation)


def _grow(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
