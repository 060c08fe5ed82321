"""The network that turns the planes of a disparity map into the probability that each pixel is right."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from tensor_stereo.dense.map_evidence import NUM_PLANES

TOLERANCES_PX = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0)  # at which it predicts
_WIDTHS = (24, 32, 48, 64)  # of features at full, half, quarter and eighth size


class ConfidenceNetwork(nn.Module):
    """A small encoder and decoder of four sizes (as Ronneberger et al., MICCAI 2015), over hand-made planes.

    Attributes:
        mean: (NUM_PLANES,) of the planes in training.
        scale: (NUM_PLANES,) one over their spread.
        calibration: (T, 2) slope and bias of every tolerance's logit.
    """

    mean: Tensor
    scale: Tensor
    calibration: Tensor

    def __init__(self) -> None:
        super().__init__()
        full, half, quarter, eighth = _WIDTHS
        self.register_buffer("mean", torch.zeros(NUM_PLANES))
        self.register_buffer("scale", torch.ones(NUM_PLANES))
        self.register_buffer("calibration", torch.tensor([[1.0, 0.0]]).repeat(len(TOLERANCES_PX), 1))
        self.enter = nn.Conv2d(NUM_PLANES, full, 1)
        self.at_full = _Residual(full)
        self.to_half = nn.Conv2d(full, half, 3, padding=1)
        self.at_half = _Residual(half)
        self.to_quarter = nn.Conv2d(half, quarter, 3, padding=1)
        self.at_quarter = _Residual(quarter)
        self.to_eighth = nn.Conv2d(quarter, eighth, 3, padding=1)
        self.at_eighth = nn.Sequential(_Residual(eighth, 2), _Residual(eighth, 4))
        self.from_eighth = nn.Conv2d(quarter + eighth, quarter, 1)
        self.at_quarter_again = _Residual(quarter)
        self.from_quarter = nn.Conv2d(half + quarter, half, 1)
        self.at_half_again = _Residual(half)
        self.from_half = nn.Conv2d(full + half, full, 1)
        self.at_full_again = _Residual(full)
        self.head = nn.Conv2d(full, len(TOLERANCES_PX), 1)

    def forward(self, planes: Tensor) -> Tensor:
        """Logits of an error of at most each tolerance, which do not fall.

        Args:
            planes: (B, NUM_PLANES, H, W) of :func:`tensor_stereo.dense.map_evidence.measure_map`; the first one is
                whether the pixel is known.

        Returns:
            (B, T, H, W), not calibrated.
        """
        known = planes[:, :1]
        x = (planes - self.mean[:, None, None]) * self.scale[:, None, None]
        x = torch.cat([x[:, :1], x[:, 1:] * known], 1).clamp(-4, 4)
        full = self.at_full(functional.relu(self.enter(x)))
        half = self.at_half(functional.relu(self.to_half(_shrink(full))))
        quarter = self.at_quarter(functional.relu(self.to_quarter(_shrink(half))))
        eighth = self.at_eighth(functional.relu(self.to_eighth(_shrink(quarter))))
        quarter = self.at_quarter_again(
            functional.relu(self.from_eighth(torch.cat([quarter, _grow(eighth, quarter)], 1)))
        )
        half = self.at_half_again(functional.relu(self.from_quarter(torch.cat([half, _grow(quarter, half)], 1))))
        full = self.at_full_again(functional.relu(self.from_half(torch.cat([full, _grow(half, full)], 1))))
        least, *steps = self.head(full).unbind(1)
        return torch.stack([least, *(functional.softplus(step) for step in steps)], 1).cumsum(1)


class _Residual(nn.Module):
    """A convolution that is added to what it sees."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + functional.relu(self.conv(x))


def _shrink(x: Tensor) -> Tensor:
    return functional.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False)


def _grow(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
