"""Settings of detectors, matchers and objects, each of one step. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tensor_stereo.limits import Count, MultipleOf, Odd, OddPx, Within, check_settings

Method = Literal["ssd", "sgbm"]

Ratio = Annotated[float, Within(0, 1, open_low=True)]
Penalty = Annotated[float, Within(0, 100, open_low=True)]


@dataclass(frozen=True)
class SIFTConfig:
    """Scale-invariant feature transform (Lowe 2004): sub-pixel keypoints, 128-vectors."""

    backend: Literal["kornia", "opencv"] = "kornia"
    max_keypoints: Count = 2000
    upright: bool = False  # no orientation: more matches between rectified views, a little fewer of them correct
    max_ratio: Ratio | None = 0.8  # best / second-best distance; Lowe 2004; None: no test

    def __post_init__(self) -> None:
        check_settings(self, prefix="SIFTConfig.")


@dataclass(frozen=True)
class FASTConfig:
    """Features from accelerated segment test (Rosten & Drummond 2006), OpenCV's detector, with image windows."""

    threshold: Annotated[int, Within(0, 255)] = 20  # grey levels by which the arc must differ from the centre
    nonmax_suppression: bool = True
    max_keypoints: Count = 2000  # the strongest are kept
    window_px: OddPx = 11  # side of the square window that SSD compares, odd

    def __post_init__(self) -> None:
        check_settings(self, prefix="FASTConfig.")


@dataclass(frozen=True)
class SURFConfig:
    """Speeded-up robust features (Bay et al. 2006), mahotas' implementation, 64-vectors."""

    num_octaves: Annotated[int, Within(1, 8)] = 4
    num_scales: Annotated[int, Within(3, 16)] = 6
    initial_step_px: Annotated[int, Within(1, 16)] = 1
    threshold: Annotated[float, Within(0)] = 0.1  # on the determinant of the Hessian, in mahotas' scale
    max_keypoints: Count = 2000

    def __post_init__(self) -> None:
        check_settings(self, prefix="SURFConfig.")


@dataclass(frozen=True)
class GFTTConfig:
    """Good features to track (Shi & Tomasi 1994), with image windows."""

    backend: Literal["kornia", "opencv"] = "kornia"
    quality_level: Annotated[float, Within(1e-9, 1)] = 0.01  # fraction of the image's strongest response
    min_distance_px: Annotated[int, Within(0, 2**15)] = 3
    max_keypoints: Count = 1000
    window_px: OddPx = 11  # side of the square window that SSD compares, odd

    def __post_init__(self) -> None:
        check_settings(self, prefix="GFTTConfig.")


@dataclass(frozen=True)
class MatchingConfig:
    """Where the partners come from, one-to-one by lowest cost. ``None`` switches a gate off.

    ``ssd``: the nearest neighbour by the sum of squared differences of the descriptors. ``sgbm``: the semi-global
    disparity map of the images, as :class:`SGBMConfig` says. Pairs must be rectified then, every partner lies on the
    row of its keypoint, and the tests that compare neighbours, ``max_ratio`` and ``mutual``, do not exist.

    Raises:
        ValueError: if a value lies outside of its limits, or settings contradict each other.
        TypeError: if a value has another type.
    """

    method: Method = "ssd"  # ssd: nearest neighbour; sgbm: semi-global matching, for rectified pairs
    max_ratio: Ratio | None = None  # best / second-best distance; None: what the detector's own settings say
    mutual: bool = False  # keep only pairs that are each other's nearest neighbour
    max_row_offset_px: Annotated[float, Within(0)] | None = None  # |y0 - y1|
    min_disparity_px: Annotated[float, Within(open_high=True)] | None = None  # x0 - x1
    max_disparity_px: Annotated[float, Within(open_low=True)] | None = None

    def __post_init__(self) -> None:
        check_settings(self, prefix="MatchingConfig.")
        low, high = self.min_disparity_px, self.max_disparity_px
        if low is not None and high is not None and low > high:
            raise ValueError(
                f"MatchingConfig.min_disparity_px must be at most MatchingConfig.max_disparity_px, got {low} > {high}"
            )
        if self.method == "sgbm":
            for name, off in (("max_ratio", None), ("mutual", False)):
                if getattr(self, name) != off:
                    given = getattr(self, name)
                    raise ValueError(
                        f"MatchingConfig.{name} must be {off} where MatchingConfig.method is 'sgbm', got {given}"
                    )


@dataclass(frozen=True)
class SGBMConfig:
    """Semi-global matching (Hirschmueller 2008), OpenCV's, whose costs are absolute differences over a window.

    The whole disparities from ``min_disparity_px`` on are searched, ``num_disparities_px`` of them; a parabola gives
    the sixteenths of a px. The penalties are those that OpenCV's manual recommends, 8 and 32 times the pixels of the
    window.

    Raises:
        ValueError: if a value lies outside of its limits, or the penalties are not in order.
        TypeError: if a value has another type.
    """

    window_px: Annotated[int, Odd(11)] = 5  # side of the square window that is compared, odd
    step_penalty_levels: Penalty = 8.0  # of a disparity step of 1 px, in grey levels per pixel of the window
    jump_penalty_levels: Penalty = 32.0  # of a larger disparity step, in grey levels per pixel of the window
    min_disparity_px: Annotated[int, Within(-1000, 1000)] = 0  # least disparity x0 - x1 that is searched
    num_disparities_px: Annotated[int, MultipleOf(16, 1024)] = 128  # number of disparities searched, a multiple of 16
    mode: Literal["sgbm", "3way", "hh"] = "3way"  # number of paths: sgbm 5, 3way 3, hh 8 as in the publication
    left_right: bool = True  # a map of view 1 too, whose difference is the cost of a match; False: no cost

    def __post_init__(self) -> None:
        check_settings(self, prefix="SGBMConfig.")
        if not self.step_penalty_levels < self.jump_penalty_levels:
            penalties = f"{self.step_penalty_levels} and {self.jump_penalty_levels}"
            raise ValueError(
                f"SGBMConfig.step_penalty_levels must be less than SGBMConfig.jump_penalty_levels, got {penalties}"
            )


@dataclass(frozen=True)
class ObjectsConfig:
    """Object contours of Restriction 3 (the paper, section 3)."""

    element_px: OddPx = 5  # side of the square structuring element, odd
    min_area_px: Annotated[float, Within(0)] = 50.0  # area that a contour must enclose

    def __post_init__(self) -> None:
        check_settings(self, prefix="ObjectsConfig.")
