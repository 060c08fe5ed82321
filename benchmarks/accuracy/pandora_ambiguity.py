"""The ambiguity of the cost curve by the package pandora, a peer of the confidence of dense maps.

Source: Sarrazin et al., "Ambiguity concept in stereo matching pipeline", ISPRS Archives XLIII-B2, 2021. The package is
part of the benchmark environment only; it is asked by its own functions, with its census costs of 5 x 5 pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def is_there() -> bool:
    try:
        import pandora  # noqa: F401
    except ImportError:
        return False
    return True


def ambiguity(left: NDArray[np.uint8], right: NDArray[np.uint8], first: int, count: int) -> NDArray[np.float32]:
    """(H, W) confidence of view 0 over disparities x0 - x1 of ``first`` on; higher is less ambiguous."""
    from pandora.cost_volume_confidence import AbstractCostVolumeConfidence
    from pandora.criteria import validity_mask
    from pandora.matching_cost import AbstractMatchingCost

    low, high = -(first + count - 1), -first  # pandora's disparities are x1 - x0
    view0, view1 = _dataset(left, low, high), _dataset(right, -high, -low)
    limits = [view0["disparity"].sel(band_disp=name) for name in ("min", "max")]
    matching = AbstractMatchingCost(matching_cost_method="census", window_size=5, subpix=1)
    costs = matching.compute_cost_volume(view0, view1, matching.allocate_cost_volume(view0, tuple(limits)))
    costs = validity_mask(view0, view1, costs)
    matching.cv_masked(view0, view1, costs, *limits)
    measure = AbstractCostVolumeConfidence(confidence_method="ambiguity")
    _, costs = measure.confidence_prediction(None, view0, view1, costs)
    return np.nan_to_num(costs["confidence_measure"].data[..., 0]).astype(np.float32)


def _dataset(image: NDArray[np.uint8], low: int, high: int):
    import xarray
    from pandora.img_tools import add_disparity

    axes = {"row": np.arange(image.shape[0]), "col": np.arange(image.shape[1])}
    dataset = xarray.Dataset({"im": (["row", "col"], image.astype(np.float32))}, coords=axes)
    dataset.attrs = {"no_data_img": -9999, "valid_pixels": 0, "no_data_mask": 1, "crs": None, "transform": None}
    return add_disparity(dataset, [low, high], window=None)
