"""Planes: how far a match is from the surface that its believed neighbours lie on."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.scores.learned_inputs import Quantities
from tensor_stereo.scores.tolerance import NUM_TOLERANCES, TOLERANCES_PX

NUM_PLANE = 9
NUM_REFINED_PLANE = NUM_PLANE + NUM_TOLERANCES
_RIDGE = 0.3  # squared mean distances to neighbours; flattens planes that too few neighbours hold
_MAX_GAP_PX = 64.0
_SOFTNESS = 0.15  # of a tolerance, over which a miss passes from within to beyond


def plane_columns(trust: Tensor, q: Quantities, *, refined: bool) -> Tensor:
    """How far each match is from the plane, and from the mean, through the disparities of its trusted neighbours.

    Args:
        trust: (M, 1) say of every match.
        q: What the network sees.
        refined: Whether the disparities of the neighbours are those that the images favour, which tell parts of a px.
            That of the match itself is as given.

    Returns:
        (M, :data:`NUM_PLANE`): functions of both distances, which fall or rise all the way; log trust. Refined, (M,
        :data:`NUM_REFINED_PLANE`): before them, softly, whether the distance from the plane stays within each
        tolerance; such steps would leave a gradient nowhere else. Gradients flow.
    """
    x, y = q.step.clamp(-4, 4).unbind(1)
    trust = trust[:, 0]
    disparity = q.refined if refined else q.disparity
    parts = []
    for near, far, sign in ((q.i, q.j, 1), (q.j, q.i, -1)):
        gap = disparity.index_select(0, far) - q.disparity.index_select(0, near)
        gap = gap.clamp(-_MAX_GAP_PX, _MAX_GAP_PX)
        sums = (torch.ones_like(x), x * x, x * y, y * y, sign * x, sign * y, sign * gap * x, sign * gap * y, gap)
        parts.append((torch.stack(sums) * trust.index_select(0, far)).t())
    total, xx, xy, yy, sx, sy, gx, gy, sg = q.receivers.sum(*parts).unbind(1)
    safe = total + 0.01
    mean_x, mean_y, mean_gap = sx / safe, sy / safe, sg / safe
    xx, yy = xx - total * mean_x * mean_x + _RIDGE, yy - total * mean_y * mean_y + _RIDGE
    xy = xy - total * mean_x * mean_y
    gx, gy = gx - total * mean_gap * mean_x, gy - total * mean_gap * mean_y
    determinant = (xx * yy - xy * xy).clamp(min=1e-3)
    slope_x, slope_y = (gx * yy - gy * xy) / determinant, (gy * xx - gx * xy) / determinant
    miss = (mean_gap - slope_x * mean_x - slope_y * mean_y).abs()
    columns = [torch.sigmoid((1 - miss / t) / _SOFTNESS) for t in TOLERANCES_PX] if refined else []
    for residual in (miss, mean_gap.abs()):
        columns += [torch.exp(-residual / scale_px) for scale_px in (0.7, 2, 6)] + [torch.log1p(residual)]
    return torch.stack([*columns, torch.log1p(total)], 1)
