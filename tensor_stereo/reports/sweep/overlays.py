"""Pictures of the worst pairs."""

from __future__ import annotations

from torch import Tensor

from tensor_stereo.reports.figures import draw_matches, figure_png
from tensor_stereo.reports.sweep.results import Overlay
from tensor_stereo.types import Matches, StereoPair


def draw_overlay(
    pair: StereoPair, matches: Matches, inlier: Tensor, correct: Tensor, valid: Tensor, *, caption: str
) -> Overlay:
    """Draw the matches of one pair by verdict and truth for a report.

    Args:
        pair: both views.
        matches: its M matches.
        inlier: (M,) bool, the verdict.
        correct: (M,) bool, disparity and row are right; ignored where ground truth is unknown.
        valid: (M,) bool, ground truth is known.
        caption: one line or two; pair, detector and settings.

    Returns:
        The picture and its caption.

    Raises:
        ValueError: as :func:`tensor_stereo.reports.figures.draw_matches`.

    Example:
        >>> import torch
        >>> image, points = torch.zeros(1, 20, 30, dtype=torch.uint8), torch.tensor([[3.0, 4.0]])
        >>> matches, kept = Matches(points, points, torch.tensor([0, 1])), torch.tensor([True])
        >>> draw_overlay(StereoPair("Art", image, image), matches, kept, kept, kept, caption="Art, FAST").caption
        'Art, FAST'
    """
    figure = draw_matches(pair.image0, pair.image1, matches, inlier, correct=correct, valid=valid)
    return Overlay(caption, figure_png(figure))
