"""Windows of images around keypoints, and what they cost where they are held against another image."""

from __future__ import annotations

import torch
from torch import Tensor

RADIUS_PX = 7  # of the largest window
NOISE_VARIANCE = 2.0  # grey levels squared; keeps windows without texture from deciding
_LIKENESS_LEVELS, _LIKENESS_PX2 = 12.0, 40.0  # fall-off of the weights of pixels unlike the 3 x 3 px in the middle
_TIGHT_LEVELS, _TIGHT_PX2 = 10.0, 8.0  # the same around the pixel in the middle alone
SMALL, MIDDLE, LIKE, TIGHT = range(4)  # whole windows, which are also held against the row
TIE = 1e-3  # log SSDs that near are alike; rounding must not choose between them
_LEAST_BEND = 0.03  # of the parabola through three SSDs, of the least one; less is noise
_FAR_PX = 4e6  # coordinates beyond lie outside of every image
NUM_WHOLE, NUM_HALVES = 4, 4  # half windows come behind the whole ones


def sample_windows(image: Tensor, centers: Tensor, radius_x: int) -> Tensor:
    """(m, 15, 2 rx + 1) grey levels around sub-pixel centres (m, 2) px; bilinear, the border repeated.

    >>> sample_windows(torch.arange(9.0).expand(5, 9), torch.tensor([[4.5, 2.0]]), 1)[0, 0]
    tensor([3.5000, 4.5000, 5.5000])
    """
    return sample_strips(image, centers[:, 0] - radius_x, centers[:, 1], 2 * radius_x + 1)


def sample_strips(image: Tensor, left: Tensor, center_y: Tensor, width: int) -> Tensor:
    """(m, 15, width) grey levels of strips that begin at x = ``left``; bilinear, the border repeated.

    >>> sample_strips(torch.arange(9.0).expand(5, 9), torch.tensor([3.0]), torch.tensor([2.0]), 3)[0, 0]
    tensor([3., 4., 5.])
    """
    height, num_columns = image.shape
    left = left.clamp(-2.0 * width, num_columns + 2.0 * width)
    center_y = center_y.clamp(-2.0 * RADIUS_PX, height + 2.0 * RADIUS_PX)
    x0, y0 = left.floor(), center_y.floor()
    fx, fy = (left - x0)[:, None, None], (center_y - y0)[:, None, None]
    rows = torch.arange(-RADIUS_PX, RADIUS_PX + 2, device=image.device)
    x = (x0.long()[:, None] + torch.arange(width + 1, device=image.device)).clamp(0, num_columns - 1)
    y = (y0.long()[:, None] + rows).clamp(0, height - 1)
    levels = image.reshape(-1)[y[:, :, None] * num_columns + x[:, None]]
    levels = levels[:, :-1] + fy * (levels[:, 1:] - levels[:, :-1])
    return levels[..., :-1] + fx * (levels[..., 1:] - levels[..., :-1])


def sample_slanted(image: Tensor, centers: Tensor, radius_x: int, shear: Tensor) -> Tensor:
    """(m, 15, 2 rx + 1) grey levels around sub-pixel centres, of the places that a slanted surface moves there.

    Args:
        image: (H, W).
        centers: (m, 2) px.
        radius_x: of the windows.
        shear: (m, 2) px/px, by how much a column of the window moves to the right with its own x and y.

    >>> sample_slanted(torch.arange(9.0).expand(5, 9), torch.tensor([[4.0, 2.0]]), 1, torch.tensor([[0.5, 0.0]]))[0, 7]
    tensor([2.5000, 4.0000, 5.5000])
    """
    none, one = torch.zeros_like(shear[:, 0]), torch.ones_like(shear[:, 0])
    axes = torch.stack([torch.stack([1 + shear[:, 0], none], 1), torch.stack([shear[:, 1], one], 1)], 1)
    offsets = torch.arange(-radius_x, radius_x + 1, device=image.device, dtype=torch.float32)
    return sample_frames(image, centers, axes, offsets)


def sample_frames(image: Tensor, origins: Tensor, axes: Tensor, offsets: Tensor) -> Tensor:
    """(m, 15, D) grey levels in frames of their own; bilinear, the border repeated.

    Args:
        image: (H, W).
        origins: (m, 2) px.
        axes: (m, 2, 2) px, the steps from column to column and from row to row.
        offsets: (D,) columns; the rows are those of all windows, -7 to 7.

    >>> axes = torch.tensor([[[0.0, 1.0], [-1.0, 0.0]]])  # columns go down
    >>> image = torch.arange(9.0)[:, None].expand(9, 5)
    >>> sample_frames(image, torch.tensor([[2.0, 3.0]]), axes, torch.tensor([-1.0, 0.0, 1.0]))[0, 7]
    tensor([2., 3., 4.])
    """
    rows = torch.arange(-RADIUS_PX, RADIUS_PX + 1, device=image.device, dtype=torch.float32)
    along, across = axes.unbind(1)
    height, width = image.shape
    base = origins.clamp(-_FAR_PX, _FAR_PX).floor()  # places count from there: small numbers keep their digits
    x, y = (
        (origins - base)[:, k, None, None]
        + offsets * along[:, k, None, None]
        + rows[:, None] * across[:, k, None, None]
        for k in (0, 1)
    )
    left, top = (base[:, k, None, None] for k in (0, 1))
    x, y = (
        torch.minimum(torch.maximum(place, -begin), size - 1 - begin)
        for place, begin, size in ((x, left, width), (y, top, height))
    )
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    u, v = (left + x0).long().clamp(0, width - 1), (top + y0).long().clamp(0, height - 1)
    right, below = (u + 1).clamp(max=width - 1), (v + 1).clamp(max=height - 1)
    flat = image.reshape(-1)
    upper, lower = (flat[row * width + u] * (1 - fx) + flat[row * width + right] * fx for row in (v, below))
    return upper + fy * (lower - upper)


def window_kernels(windows: Tensor) -> Tensor:
    """(m, 225, 8) weights with sum 1 of the pixels of m windows.

    5 x 5 and 11 x 11 boxes; pixels like the 3 x 3 px in the middle (Yoon & Kweon 2006); of 11 x 11 those near the
    middle and like it, which keep to one side of an edge; and the left, right, upper and lower half of 11 x 11.

    >>> window_kernels(torch.rand(2, 15, 15)).sum(1)[0, :3]
    tensor([1.0000, 1.0000, 1.0000])
    """
    side = windows.shape[1]
    r = torch.arange(side, device=windows.device) - RADIUS_PX
    y, x = r[:, None].expand(side, side), r.expand(side, side)
    middle = (x.abs() <= 5) & (y.abs() <= 5)
    small = (x.abs() <= 2) & (y.abs() <= 2)
    boxes = torch.stack([small, middle]).float().expand(len(windows), -1, -1, -1)
    halves = torch.stack([middle & (x <= 1), middle & (x >= -1), middle & (y <= 1), middle & (y >= -1)])
    far = (x.square() + y.square()).float()
    center = windows[:, RADIUS_PX - 1 : RADIUS_PX + 2, RADIUS_PX - 1 : RADIUS_PX + 2].mean((1, 2))
    like = _likeness(windows, center, _LIKENESS_LEVELS, far / _LIKENESS_PX2) + 1e-4
    tight = _likeness(windows, windows[:, RADIUS_PX, RADIUS_PX], _TIGHT_LEVELS, far / _TIGHT_PX2) + 1e-5
    tight = tight * middle
    weights = torch.cat([boxes, like, tight, halves.float().expand(len(windows), -1, -1, -1)], 1).flatten(2)
    return (weights / weights.sum(2, keepdim=True)).transpose(1, 2)


def compare_windows(
    windows: Tensor, strips: Tensor, kernels: Tensor, *, has_tight: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Log zero-mean SSD (m, D, K), correlation (m, D, K), and log variance of the windows (m, K).

    No gradient.

    Args:
        windows: (m, 15, 15).
        strips: (m, 15, D + 14): D windows, each one column on.
        kernels: (m, 225, K) weights.
        has_tight: Whether they are the first ones of :func:`window_kernels`, with :data:`TIGHT` among them, whose SSD
            also counts how far the means differ.

    >>> windows = torch.rand(1, 15, 15)
    >>> compare_windows(windows, windows, window_kernels(windows), has_tight=True)[0].exp().round()
    tensor([[[2., 2., 2., 2., 2., 2., 2., 2.]]])
    """
    side = windows.shape[1]
    # Levels count from the pixel in the middle, and squares from differences: both are small where windows are alike.
    level = windows[:, side // 2, side // 2]
    anchor = (windows - level[:, None, None]).flatten(1)
    moving = strips.unfold(2, side, 1).transpose(1, 2).reshape(len(strips), -1, side * side)
    shift = moving[..., side * side // 2]
    moving = moving - shift[..., None]
    mean, anchor_mean = moving @ kernels, anchor[:, None] @ kernels
    gap = anchor_mean - mean
    difference = ((anchor[:, None] - moving).square_() @ kernels - gap.square()).clamp(min=0)
    variance = (moving.square_() @ kernels - mean.square()).clamp(min=0)
    anchor_variance = (kernels * (anchor[..., None] - anchor_mean).square()).sum(1)
    covariance = (variance + anchor_variance[:, None] - difference) / 2
    if has_tight:
        difference[..., TIGHT] += (gap[..., TIGHT] + level[:, None] - shift).square()
    scale = (variance + NOISE_VARIANCE) * (anchor_variance[:, None] + NOISE_VARIANCE)
    return torch.log(difference + NOISE_VARIANCE), covariance / scale.sqrt(), torch.log(anchor_variance + 1)


def lowest_place(log_ssd: Tensor) -> Tensor:
    """(m, K) places from the middle one to the lowest of (m, D, K), by the parabola of the SSD around it.

    Of places whose SSDs differ by less than a thousandth the one nearest to the middle counts, of two such the first.

    >>> lowest_place(torch.tensor([9.0, 4.0, 1.0, 1.0, 4.0]).log()[None, :, None])
    tensor([[0.5000]])
    """
    ssd = log_ssd.exp()
    num_places = ssd.shape[1]
    away = (torch.arange(num_places, device=ssd.device) - num_places // 2).abs()[:, None].expand_as(ssd)
    least = ssd.amin(1, keepdim=True)
    k = away.masked_fill(ssd > least * (1 + TIE), num_places).argmin(1, keepdim=True).clamp(1, num_places - 2)
    return k[:, 0] - num_places // 2 + parabola_offset(ssd, k).clamp(-1, 1)


def parabola_offset(ssd: Tensor, k: Tensor) -> Tensor:
    """(m, ...) how far from the places k (m, 1, ...) of (m, D, ...) the parabola through three places is lowest.

    >>> parabola_offset(torch.tensor([[4.0, 1.0, 1.0, 4.0]]), torch.tensor([[1]]))
    tensor([0.5000])
    """
    before, least, after = (ssd.gather(1, k + step)[:, 0] for step in (-1, 0, 1))
    bend = torch.maximum(before - 2 * least + after, _LEAST_BEND * least)
    return (before - after) / (2 * bend)


def _likeness(windows: Tensor, center: Tensor, levels: float, far: Tensor) -> Tensor:
    unlike = (windows - center[:, None, None]).abs() / levels
    return torch.exp(-unlike - far)[:, None]
