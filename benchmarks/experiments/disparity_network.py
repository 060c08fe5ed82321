"""A small disparity network, trained from sparse weighted labels, and its errors against ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

import tensor_stereo as ts
from tensor_stereo.features import to_gray

Labels = tuple[Tensor, Tensor, Tensor]  # pixels (n, 2), disparity (n,), weight (n,)


@dataclass(frozen=True)
class TrainingConfig:
    """Settings that all conditions share; lengths of crops in pixels of the halved images."""

    steps: int = 400
    pairs_per_step: int = 2
    crop_height_px: int = 64
    crop_width_px: int = 192
    learning_rate: float = 1.5e-3
    smoothness: float = 0.3  # weight of the edge-aware term per px of disparity, reached linearly at the end
    edge_levels: float = 10.0  # grey-level step that lets disparity jump


class DisparityNet(nn.Module):
    """Correlation of learned features plus a correction by an hourglass of 2-D convolutions, then a soft argmax.

    Works on images of half size; 1 step of the cost volume is 2 px of the full image.
    """

    def __init__(self, num_disparities: int = 40, feature_width: int = 24, width: int = 48) -> None:
        super().__init__()
        self.num_disparities = num_disparities
        self.first = _conv(1, feature_width)
        self.second = _conv(feature_width, feature_width)
        self.third = _conv(feature_width, feature_width)
        self.down = nn.ModuleList([_conv(num_disparities + feature_width, width, 2), _conv(width, width, 2)])
        self.inner = _conv(width, width)
        self.context = nn.ModuleList([_conv(width, width, dilation=n) for n in (1, 2, 4)])
        self.merge = _conv(2 * width, width)
        self.correction = nn.Conv2d(width, 4 * num_disparities, 1)
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(15.0)))
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def forward(self, image0: Tensor, image1: Tensor) -> Tensor:
        """Disparity (B, H, W) in px of the full images, from two (B, 1, H, W) halved ones; H and W multiples of 4."""
        features0, features1 = self.describe(torch.cat([image0, image1])).chunk(2)
        volume = correlate(features0, features1, self.num_disparities)  # (B, D, H, W)
        half = functional.leaky_relu(self.down[0](torch.cat([volume, features0], 1)))
        half = half + functional.leaky_relu(self.inner(half))
        quarter = functional.leaky_relu(self.down[1](half))
        for layer in self.context:
            quarter = quarter + functional.leaky_relu(layer(quarter))
        wide = functional.interpolate(quarter, scale_factor=2, mode="bilinear", align_corners=False)
        merged = functional.leaky_relu(self.merge(torch.cat([half, wide], 1)))
        logits = self.log_sharpness.exp() * volume + functional.pixel_shuffle(self.correction(merged), 2)
        steps = torch.arange(self.num_disparities, dtype=logits.dtype, device=logits.device)
        return 2 * torch.einsum("bdhw,d->bhw", logits.softmax(1), steps)

    def describe(self, images: Tensor) -> Tensor:
        """Unit vectors (B, C, H, W)."""
        features = functional.leaky_relu(self.first(normalize_contrast(images)))
        features = features + functional.leaky_relu(self.second(features))
        return functional.normalize(self.third(features), dim=1)


def _conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation)


def correlate(features0: Tensor, features1: Tensor, num_disparities: int) -> Tensor:
    """Cosine (B, D, H, W) of each pixel of view 0 and the pixel d columns to its left in view 1; 0 beyond the image."""
    rows0, rows1 = features0.permute(0, 2, 3, 1), features1.permute(0, 2, 1, 3)
    products = rows0 @ rows1  # (B, H, W, W), all pairs of one row
    x0 = torch.arange(features0.shape[3], device=features0.device)
    x1 = x0[:, None] - torch.arange(num_disparities, device=features0.device)  # (W, D)
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


def train(pairs: Sequence[ts.StereoPair], labels: Sequence[Labels], config: TrainingConfig, seed: int) -> TrainedNet:
    """Fit a new network to labels; weights, pairs and crops follow from the seed alone and are equal for all labels."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = DisparityNet()
    generator = torch.Generator().manual_seed(seed)
    images = [(halve(pair.image0), halve(pair.image1)) for pair in pairs]
    optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, config.steps, pct_start=0.3)
    losses = []
    for step in range(config.steps):
        crops = [_crop(images, labels, config, generator) for _ in range(config.pairs_per_step)]
        image0, image1 = (torch.stack([crop[view] for crop in crops]) for view in (0, 1))
        disparity = net(image0, image1)
        data = label_loss(disparity, [crop[2] for crop in crops])
        loss = data + config.smoothness * step / config.steps * smoothness(disparity, image0[:, 0], config.edge_levels)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        losses.append(data.item())
    return TrainedNet(net.eval(), losses)


@dataclass(frozen=True, eq=False)
class TrainedNet:
    """A network and the label loss of every step in px."""

    net: DisparityNet
    losses: list[float]

    @torch.no_grad()
    def predict(self, pair: ts.StereoPair) -> Tensor:
        """Disparity (H, W) of view 0 in px."""
        image0, image1 = (halve(image)[None] for image in (pair.image0, pair.image1))
        height, width = image0.shape[2:]
        margin = (0, -width % 4, 0, -height % 4)
        disparity = self.net(*(functional.pad(image, margin, mode="replicate") for image in (image0, image1)))
        full = double(disparity)[0]
        return full[: pair.image0.shape[1], : pair.image0.shape[2]]

    def errors(self, pairs: Sequence[ts.StereoPair]) -> dict[str, dict[str, float]]:
        """Per pair, over all pixels with ground truth: mean absolute error in px, share off by more than 2 px."""
        table = {}
        for pair in pairs:
            error = (self.predict(pair) - pair.disparity_gt).abs()
            error = error[error.isfinite()]
            table[pair.name] = {"epe_px": float(error.mean()), "bad_2px": float((error > 2).float().mean())}
        return table


def _crop(
    images: Sequence[tuple[Tensor, Tensor]],
    labels: Sequence[Labels],
    config: TrainingConfig,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Labels]:
    """The same window of both views of a random pair, and the labels that lie in it in both views."""
    index, *place = torch.rand(3, generator=generator).tolist()
    b = int(index * len(images))
    size = config.crop_height_px, config.crop_width_px
    top, left = (int(f * (n - c + 1)) for f, n, c in zip(place, images[b][0].shape[1:], size, strict=True))
    views = [image[:, top : top + size[0], left : left + size[1]] for image in images[b]]
    pixels, disparity, weight = labels[b]
    pixels = pixels - 2 * pixels.new_tensor([left, top])
    inside = ((pixels >= 0) & (pixels < 2 * pixels.new_tensor(size[::-1]))).all(1) & (pixels[:, 0] >= disparity)
    return *views, (pixels[inside], disparity[inside], weight[inside])


def double(disparity: Tensor) -> Tensor:
    """Halved maps (B, H, W) at full size; the centre of halved pixel i lies at 2 i + 0.5."""
    return functional.interpolate(disparity[:, None], scale_factor=2, mode="bilinear", align_corners=False)[:, 0]


def label_loss(disparity: Tensor, labels: Sequence[Labels]) -> Tensor:
    """Weighted mean of the smooth L1 distance in px at the labelled pixels; 0 without labels."""
    full = double(disparity)
    lengths = torch.tensor([len(weight) for *_, weight in labels])
    b = torch.repeat_interleave(lengths)
    pixels, target, weight = (torch.cat(column) for column in zip(*labels, strict=True))
    distance = functional.smooth_l1_loss(full[b, pixels[:, 1], pixels[:, 0]], target, reduction="none")
    return (weight * distance).sum() / weight.sum().clamp(min=1e-6)


def smoothness(disparity: Tensor, image: Tensor, edge_levels: float) -> Tensor:
    """Mean absolute step of disparity, damped where the image (B, H, W) steps too."""
    terms = [
        (disparity.diff(dim=axis).abs() * (-image.diff(dim=axis).abs() / edge_levels).exp()).mean() for axis in (1, 2)
    ]
    return terms[0] + terms[1]
