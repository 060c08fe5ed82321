"""The rendered set: scenes with exact sub-pixel ground truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset as SyntheticDataset
    from tensor_stereo.datasets.synthetic.rendering import render_pair as render_pair
    from tensor_stereo.datasets.synthetic.rendering import write_synthetic as write_synthetic

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "SyntheticDataset": "rendering",
        "render_pair": "rendering",
        "write_synthetic": "rendering",
    },
)
