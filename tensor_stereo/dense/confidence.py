"""Stereo confidence: how likely is every pixel of a disparity map right, whoever made the map?"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensor_stereo.dense.confidence_network import TOLERANCES_PX, ConfidenceNetwork
from tensor_stereo.dense.map_evidence import measure_map
from tensor_stereo.dense.matching_costs import Floats
from tensor_stereo.features.images import list_images, map_threads, to_gray
from tensor_stereo.scores.calibration import keep_by_target
from tensor_stereo.types import check_tensor

_PIXELS_AT_ONCE = 2**20  # that are looked at in parallel, or one map
WEIGHTS = Path(__file__).with_name("weights_confidence.safetensors")
Images = Tensor | Sequence[Tensor]


class ScoredDisparity(NamedTuple):
    """The confidence of B disparity maps, on their pixels or on a grid of them; H' = ceil(H / stride), W' likewise.

    Attributes:
        probability: (B, 1, H', W') float32, calibrated: that the error is at most the tolerance asked for; 0 where the
            disparity is unknown.
        known: (B, 1, H', W') bool, where there is a disparity.
        disparity: (B, 1, H', W') float32 px, NaN where unknown.
        cumulative: (B, T, H', W') float32 probabilities of an error of at most each of the T = 7 tolerances .5, 1, 2,
            3, 5, 8 and 12 px; they do not fall.
        stride: Distance of the pixels that are judged; the first one is pixel (0, 0).
    """

    probability: Tensor
    known: Tensor
    disparity: Tensor
    cumulative: Tensor
    stride: int

    def within(self, max_error_px: float, max_error_share: float = 0.0) -> Tensor:
        """The probability of another tolerance from the same pass; see :func:`score_disparity`.

        >>> zeros = torch.zeros(1, 1, 2, 2)
        >>> found = ScoredDisparity(zeros, zeros > 0, zeros, torch.full((1, 7, 2, 2), 0.25), 1)
        >>> found.within(3.0, 0.05).unique()
        tensor([0.2500])
        """
        return _within(self.cumulative, self.disparity, max_error_px, max_error_share)

    def keep(self, *, threshold: float | None = None, min_precision: float | None = None) -> Tensor:
        """Which pixels to trust: those above a probability, or as many as have an expected precision.

        Args:
            threshold: Least probability; None: .5, unless ``min_precision`` is given.
            min_precision: Least expected share of the kept pixels of a map that is right; the largest such set.

        Returns:
            (B, 1, H', W') bool; False where the disparity is unknown.

        Raises:
            ValueError: if both are given, or one lies outside of [0, 1].
        """
        check_verdict(threshold, min_precision)
        if min_precision is None:
            return self.known & (self.probability >= (0.5 if threshold is None else threshold))
        size = self.known.shape[1:].numel()
        ptr = torch.arange(len(self.known) + 1, device=self.known.device) * size
        kept = keep_by_target(self.probability.flatten(), self.known.flatten(), ptr, min_precision=min_precision)
        return kept.view_as(self.known)

    def filter(self, *, threshold: float | None = None, min_precision: float | None = None) -> Tensor:
        """(B, 1, H', W') float32 the disparities of :meth:`keep`, NaN elsewhere."""
        return self.disparity.where(self.keep(threshold=threshold, min_precision=min_precision), torch.nan)


class DisparityConfidence(nn.Module):
    """The calibrated probability that every pixel of a disparity map is right, from the map and the two images.

    It takes maps of any method: a network of this package looks at hand-made measures (how far the disparities around
    agree, what two matching costs say at the estimate and at all others, from both views, texture, borders). It has
    learnt from maps of semi-global and block matching, of winners of a census, of grey levels and of a small matching
    network, of filled and of fitted maps. Its probabilities are calibrated on scenes that it was trained without.
    Sources of the measures: Hu & Mordohai, PAMI 34(11), 2012; Poggi, Tosi & Mattoccia, "Quantitative evaluation of
    confidence measures in a machine learning world", ICCV 2017.

    Args:
        max_error_px: A pixel is right if its error is at most this, .5 to 12 px,
        max_error_share: or at most this share of its estimate: KITTI's rule is ``max_error_px=3`` and .05. Where that
            is more than 12 px, 12 px count.
        stride: Distance of the pixels that are judged.

    >>> image = torch.randint(0, 256, (1, 1, 40, 70), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    >>> confidence = DisparityConfidence(max_error_px=3, max_error_share=0.05)
    >>> found = confidence(torch.full((1, 1, 40, 64), 6.0), image[..., :64], image[..., 6:])
    >>> bool((found.probability[..., 8:-8, 12:-8] > 0.9).all())
    True
    """

    def __init__(self, max_error_px: float = 1.0, max_error_share: float = 0.0, stride: int = 1) -> None:
        super().__init__()
        check_settings(max_error_px, max_error_share, stride)
        self.max_error_px, self.max_error_share, self.stride = max_error_px, max_error_share, stride
        with torch.inference_mode(False):  # as in load_confidence
            self.network = deepcopy(load_confidence())  # its own: modules are moved and trained

    def extra_repr(self) -> str:
        return f"max_error_px={self.max_error_px}, max_error_share={self.max_error_share}, stride={self.stride}"

    @torch.no_grad()
    def forward(
        self,
        disparity: Tensor,
        images0: Images,
        images1: Images,
        disparity1: Tensor | None = None,
        *,
        scale: float | None = None,
        unknown: float | None = None,
    ) -> ScoredDisparity:
        """Score the maps; see :func:`score_disparity`."""
        maps = read_maps("disparity", disparity, scale, unknown)
        maps1 = None if disparity1 is None else read_maps("disparity1", disparity1, scale, unknown)
        if maps1 is not None and maps1.shape != maps.shape:
            raise ValueError(
                f"disparity1 must have the shape {tuple(maps.shape)} of disparity, got {tuple(maps1.shape)}"
            )
        views = [_read_views(name, images, maps) for name, images in (("images0", images0), ("images1", images1))]
        given, image0, image1 = (part[:, 0].cpu().numpy() for part in (maps, *views))
        other = None if maps1 is None else maps1[:, 0].cpu().numpy()

        def look(b: int) -> Floats:
            return measure_map(given[b], image0[b], image1[b], None if other is None else other[b], self.stride)

        device = self.network.mean.device
        at_once = max(1, _PIXELS_AT_ONCE // max(maps[0].numel() if len(maps) else 1, 1))
        logits = []
        for begin in range(0, len(maps), at_once):
            seen = map_threads(look, range(begin, min(begin + at_once, len(maps))))
            logits += [self.network(torch.from_numpy(planes)[None].to(device)).to(maps.device) for planes in seen]
        grid = maps[..., :: self.stride, :: self.stride]
        known = grid.isfinite()
        logit = torch.cat(logits) if logits else known.float().expand(-1, len(TOLERANCES_PX), -1, -1)
        calibration = self.network.calibration.to(maps.device)
        slope, bias = (column[:, None, None] for column in calibration.unbind(1))
        cumulative = torch.sigmoid(logit * slope + bias).cummax(1).values * known
        grid = grid.masked_fill(~known, torch.nan)
        probability = _within(cumulative, grid, self.max_error_px, self.max_error_share)
        return ScoredDisparity(probability, known, grid, cumulative, self.stride)


def score_disparity(
    disparity: Tensor,
    images0: Images,
    images1: Images,
    disparity1: Tensor | None = None,
    stride: int | None = None,
    *,
    max_error_px: float = 1.0,
    max_error_share: float = 0.0,
    scale: float | None = None,
    unknown: float | None = None,
) -> ScoredDisparity:
    """The calibrated probability that every pixel of a disparity map is right.

    From two images to a map of which 95 % are expected to be right::

        maps = match_semi_global(left, right)
        found = score_disparity(maps.disparity0[0], left, right, maps.disparity1[0])
        disparity = found.filter(min_precision=0.95)  # NaN where it is not to be trusted

    Args:
        disparity: (B, 1, H, W) of view 0, x0 - x1 in px, or (H, W) for one map: float32 or float64, or integers with
            ``scale``. NaN and infinite values are unknown.
        images0: Images of view 0, the view of the map, rectified: (B, C, H, W), or a list of (C, H, W), C = 1 or 3
            (RGB), uint8 or floating point in [0, 1]; (C, H, W) for one map.
        images1: Images of view 1, of the same sizes.
        disparity1: Likewise of view 1, x0 - x1 at the pixels of view 1; None: not known. With it results are better.
        stride: Only every so many pixels of every so many rows are judged, in a fraction of the time; None: all.
        max_error_px: A pixel is right if its error is at most this, .5 to 12 px,
        max_error_share: or at most this share of its estimate: KITTI's rule is ``max_error_px=3`` and .05. Where that
            is more than 12 px, 12 px count.
        scale: Values of the maps that stand for one px: 16 for what OpenCV's matchers return; None: 1.
        unknown: A value of the maps that stands for an unknown disparity, as stored; None: there is none.

    Returns:
        Probabilities with what belongs to them, on the device of the map. Those of a map do not depend on the rest of
        the batch. A map that spans more than 256 px is searched in the 256 disparities that hold most of its pixels;
        others get little confidence. At stride 1 about 1 kB is needed for each pixel. No gradient.

    Raises:
        ValueError: if shapes disagree, or a setting lies out of range.
        TypeError: if the map has another dtype, or holds integers without ``scale``.

    >>> image = torch.randint(0, 256, (1, 40, 70), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    >>> found = score_disparity(torch.full((40, 64), 96), image[..., :64], image[..., 6:], stride=4, scale=16)
    >>> found.probability.shape, float(found.disparity[0, 0, 5, 5])
    (torch.Size([1, 1, 10, 16]), 6.0)
    """
    module = DisparityConfidence(max_error_px, max_error_share, 1 if stride is None else stride)
    found: ScoredDisparity = module(disparity, images0, images1, disparity1, scale=scale, unknown=unknown)
    return found


@cache
def load_confidence() -> ConfidenceNetwork:
    """The network with the weights of this package, in evaluation mode and without gradients of its weights.

    Returns:
        One network per process, on the CPU, shared by all callers.

    >>> load_confidence().training
    False
    """
    from safetensors.torch import load_file

    with torch.inference_mode(False):  # weights that were made in it could never take part in a gradient
        network = ConfidenceNetwork().float()
        network.load_state_dict(load_file(WEIGHTS))
        return network.requires_grad_(False).eval()


def read_maps(name: str, disparity: Tensor, scale: float | None = None, unknown: float | None = None) -> Tensor:
    """(B, 1, H, W) float32 px, NaN where unknown.

    Args:
        name: Name of the argument, for errors.
        disparity: (B, 1, H, W) or (H, W).
        scale: Values that stand for one px.
        unknown: A value that stands for an unknown disparity, as stored.

    >>> read_maps("disparity", torch.tensor([[32, -16]], dtype=torch.int16), 16, -16)
    tensor([[[[2., nan]]]])
    """
    check_tensor(name, disparity)
    maps = disparity[None, None] if disparity.ndim == 2 else disparity
    if maps.ndim != 4 or maps.shape[1] != 1 or 0 in maps.shape[2:]:
        raise ValueError(f"{name} must have shape (B, 1, H, W), or (H, W) for one map, got {tuple(disparity.shape)}")
    if not maps.is_floating_point():
        if maps.dtype == torch.bool or maps.is_complex():
            raise TypeError(f"{name} must hold floating-point numbers or integers, got {maps.dtype}")
        if scale is None:
            raise TypeError(
                f"scale must be given for {name} of {maps.dtype}: the stored value of one px, 16 for OpenCV"
            )
    if scale is not None and not (0 < scale < float("inf")):
        raise ValueError(f"scale must be a positive number, got {scale}")
    values = maps.detach().double()
    if unknown is not None:
        values = values.masked_fill(values == unknown, torch.nan)
    found = (values / (1 if scale is None else scale)).float()
    return found.masked_fill(~found.isfinite(), torch.nan)


def _read_views(name: str, images: Images, maps: Tensor) -> Tensor:
    """(B, 1, H, W) grey levels, of the size of the maps."""
    views = list_images(name, images, len(maps))
    for b, view in enumerate(views):
        if view.shape[1:] != maps.shape[2:]:
            sizes = f"{tuple(maps.shape[2:])} of the map, got {tuple(view.shape[1:])}"
            raise ValueError(f"{name}[{b}] must have the size {sizes}")
    return (
        torch.cat([to_gray(view[None]) for view in views]) if views else maps.new_zeros(maps.shape, dtype=torch.uint8)
    )


def check_verdict(threshold: float | None, min_precision: float | None) -> None:
    """Raise unless at most one is given, and in [0, 1].

    >>> check_verdict(None, 0.95)
    """
    if threshold is not None and min_precision is not None:
        raise ValueError(f"threshold must be None beside min_precision, got {threshold} and {min_precision}")
    for name, value in (("threshold", threshold), ("min_precision", min_precision)):
        if value is not None and not 0 <= value <= 1:
            raise ValueError(f"{name} must lie in [0, 1], got {value}")


def check_settings(max_error_px: float, max_error_share: float, stride: int) -> None:
    """Raise for a tolerance or a stride out of range.

    >>> check_settings(3, 0.05, 1)
    """
    _check_tolerance(max_error_px, max_error_share)
    if isinstance(stride, bool) or not isinstance(stride, int):
        raise TypeError(f"stride must be an integer number of px, got {stride!r}")
    if stride < 1:
        raise ValueError(f"stride must be at least 1 px, got {stride}")


def _check_tolerance(max_error_px: float, max_error_share: float) -> None:
    if not TOLERANCES_PX[0] <= max_error_px <= TOLERANCES_PX[-1]:
        limits = f"{TOLERANCES_PX[0]:g} and {TOLERANCES_PX[-1]:g} px"
        raise ValueError(f"max_error_px must lie between {limits}, got {max_error_px}")
    if not 0 <= max_error_share < 1:
        raise ValueError(f"max_error_share must lie in [0, 1), got {max_error_share}")


def _within(cumulative: Tensor, disparity: Tensor, max_error_px: float, max_error_share: float) -> Tensor:
    """(B, 1, H, W) probability of an error of at most a tolerance of every pixel, linear between those predicted."""
    _check_tolerance(max_error_px, max_error_share)
    steps = torch.tensor(TOLERANCES_PX, device=cumulative.device)
    tolerance = (max_error_share * disparity.nan_to_num(0).abs()).clamp(max_error_px, TOLERANCES_PX[-1])
    above = torch.searchsorted(steps, tolerance).clamp(1, len(steps) - 1)
    low, high = steps[above - 1], steps[above]
    share = (tolerance - low) / (high - low)
    return torch.lerp(cumulative.gather(1, above - 1), cumulative.gather(1, above), share)
