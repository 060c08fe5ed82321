"""Settings of every step, as frozen dataclasses with units in the field names. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

Detector = Literal["sift", "fast", "surf", "gftt"]
Restriction = Literal["adjacency", "cardinality"]
TemperatureUnit = Literal["edge", "px"]
Score = Literal["topology", "consensus", "learned"]
ScoreName = Literal["none", Score]  # none: no score, and no curve in the results
Backend = Literal["auto", "native", "scipy"]

RESTRICTIONS: tuple[Restriction, ...] = get_args(Restriction)
SCORES: tuple[Score, ...] = get_args(Score)
CUTS = ("threshold", "target_sensitivity", "min_precision")  # ways to a verdict by score, of which one may be given
DETECTORS: tuple[Detector, ...] = ("sift", "fast", "surf", "gftt")  # order of the paper's Tables 1-4


@dataclass(frozen=True)
class SIFTConfig:
    """Scale-invariant feature transform (Lowe 2004): sub-pixel keypoints, 128-vectors."""

    backend: Literal["kornia", "opencv"] = "kornia"
    max_keypoints: int = 2000
    upright: bool = False  # no orientation: more matches between rectified views, a little fewer of them correct
    max_ratio: float | None = 0.8  # best / second-best distance; Lowe 2004; None: no test


@dataclass(frozen=True)
class FASTConfig:
    """Features from accelerated segment test (Rosten & Drummond 2006), OpenCV's detector, with image windows."""

    threshold: int = 20  # grey levels by which the arc must differ from the centre
    nonmax_suppression: bool = True
    max_keypoints: int = 2000  # the strongest are kept
    window_px: int = 11  # side of the square window that SSD compares, odd


@dataclass(frozen=True)
class SURFConfig:
    """Speeded-up robust features (Bay et al. 2006), mahotas' implementation, 64-vectors."""

    num_octaves: int = 4
    num_scales: int = 6
    initial_step_px: int = 1
    threshold: float = 0.1  # on the determinant of the Hessian, in mahotas' scale
    max_keypoints: int = 2000


@dataclass(frozen=True)
class GFTTConfig:
    """Good features to track (Shi & Tomasi 1994), with image windows."""

    backend: Literal["kornia", "opencv"] = "kornia"
    quality_level: float = 0.01  # fraction of the image's strongest response
    min_distance_px: int = 3
    max_keypoints: int = 1000
    window_px: int = 11  # side of the square window that SSD compares, odd


@dataclass(frozen=True)
class MatchingConfig:
    """Nearest neighbour by sum of squared differences, one-to-one by lowest cost. ``None`` switches a gate off."""

    max_ratio: float | None = None  # best / second-best distance; None: what the detector's own settings say
    mutual: bool = False  # keep only pairs that are each other's nearest neighbour
    max_row_offset_px: float | None = None  # |y0 - y1|
    min_disparity_px: float | None = None  # x0 - x1
    max_disparity_px: float | None = None


@dataclass(frozen=True)
class ObjectsConfig:
    """Object contours of Restriction 3 (the paper, section 3)."""

    element_px: int = 5  # side of the square structuring element, odd
    min_area_px: float = 50.0  # area that a contour must enclose


@dataclass(frozen=True)
class ClassifyConfig:
    """The set test on the two Delaunay graphs (the paper, section 3), and the score of every match beside it.

    ``threshold``, ``target_sensitivity`` or ``min_precision`` make the verdict one of the score instead of the
    restriction. The last two choose the threshold of each pair from calibrated scores, by what these let expect.
    """

    restriction: Restriction = "cardinality"
    min_group_size: int = 4  # distinct matches below which a group says nothing
    tie_tolerance: float = 1e-3  # in edge lengths
    backend: Backend = "auto"
    score: ScoreName = "consensus"
    temperature: float = 1.0  # of the score topology
    temperature_unit: TemperatureUnit = "edge"
    threshold: float | None = None  # least score of a match that is kept
    target_sensitivity: float | None = None  # fraction of the incorrect matches that are rejected, at least
    min_precision: float | None = None  # fraction of the kept matches that are correct, at least

    def __post_init__(self) -> None:
        given = [name for name in CUTS if getattr(self, name) is not None]
        for name in given:
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must lie in [0, 1] or be None, got {value}")
            if self.score == "none":
                raise ValueError(f"{name} must be None where score is 'none', got {value}")
            if self.score == "topology" and name != "threshold":
                raise ValueError(f"{name} needs a calibrated score, which 'topology' is not; got {value}")
        if len(given) > 1:
            raise ValueError(f"{given[1]} must be None beside {given[0]}, got {getattr(self, given[1])}")

    @property
    def by_score(self) -> bool:
        """Whether the score decides, not the restriction."""
        return any(getattr(self, name) is not None for name in CUTS)


def describe_verdict(settings: Mapping[str, Any]) -> str:
    """What decides under some settings, in a few words.

    >>> describe_verdict({"restriction": "adjacency"}), describe_verdict({"score": "learned", "min_precision": 0.9})
    ('adjacency', 'learned, min precision 0.9')
    """
    for name in CUTS:
        if settings.get(name) is not None:
            return f"{settings['score']}, {name.replace('_', ' ')} {settings[name]:g}"
    return str(settings["restriction"])


@dataclass(frozen=True)
class ConsensusConfig:
    """Settings of the consensus score, of what the neighbours of a match believe.

    Two of them have a second value for keypoints on whole pixels, whose rounding is larger than the errors of sub-pixel
    keypoints; what lies between is interpolated. Which keypoints are given is measured, pair by pair.
    """

    tolerance_px: float = 0.6  # difference to a neighbour's plane at which agreement has fallen to exp(-1/2)
    whole_tolerance_px: float = 1.0
    row_tolerance_px: float | None = 0.25  # row offset that halves the odds; None: the pair is not rectified
    whole_row_tolerance_px: float = 1.5
    slope: float = 0.2  # expected change of the displacement per px of distance, px/px
    reach: float = 2.0  # distance, in edge lengths around the match, at which a neighbour's vote counts half
    doubt: float = 1.0  # votes against every match, so that few votes are less than many
    cost_weight: float = 0.5  # log-odds per standard deviation of the logarithm of the cost
    num_rounds: int = 2


UNRECTIFIED = ConsensusConfig(row_tolerance_px=None)  # for pairs of any two views


@dataclass(frozen=True)
class StepConfigs(ClassifyConfig):
    """Settings of all steps, whichever detector runs."""

    sift: SIFTConfig = field(default_factory=SIFTConfig)
    fast: FASTConfig = field(default_factory=FASTConfig)
    surf: SURFConfig = field(default_factory=SURFConfig)
    gftt: GFTTConfig = field(default_factory=GFTTConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)


@dataclass(frozen=True)
class PipelineConfig(StepConfigs):
    """From two images to verdicts."""

    detector: Detector = "fast"
    constrained: bool = False  # Restriction 3: split the matches by object first


@dataclass(frozen=True)
class TrialConfig(PipelineConfig):
    """One point of a sweep's grid: a pipeline, and what is done to its putative matches."""

    outlier_rate: float = 0.0  # fraction of the matches whose partners in view 1 change places among them
    noise_px: float = 0.0  # standard deviation added to x and y of both keypoints
    seed: int = 0  # of outliers and noise, together with the name of the pair
    max_error_px: float = 1.0  # a match is correct iff its disparity is off by no more

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.outlier_rate <= 1:
            raise ValueError(f"outlier_rate must lie in [0, 1], got {self.outlier_rate}")
        if not 0 <= self.noise_px < float("inf"):
            raise ValueError(f"noise_px must be finite and not negative, got {self.noise_px}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True)
class SweepConfig:
    """The points of a grid, each of which every pair goes through."""

    trials: tuple[TrialConfig, ...] = (TrialConfig(),)
    export_matches: bool = False  # whether every match with its verdict is kept, for training

    def __post_init__(self) -> None:
        if not self.trials:
            raise ValueError("trials must hold at least one point")


@dataclass(frozen=True)
class EvaluationConfig(StepConfigs):
    """From pairs with ground truth to the paper's tables; ``restriction`` is the one that the tables show."""

    min_group_size: int = 1  # 1: the paper read literally
    detectors: tuple[Detector, ...] = DETECTORS
    max_error_px: float = 1.0  # a match is correct iff its disparity is off by no more

    def trials(self, detector: Detector) -> tuple[TrialConfig, ...]:
        """The same settings for one detector: without and with Restriction 3, under both restrictions."""
        shared = {f.name: getattr(self, f.name) for f in fields(StepConfigs)} | {"detector": detector}
        return tuple(
            TrialConfig(
                **shared | {"restriction": restriction},
                constrained=constrained,
                max_error_px=self.max_error_px,
            )
            for constrained in (False, True)
            for restriction in RESTRICTIONS
        )


@dataclass(frozen=True)
class SyntheticConfig:
    """Size and difficulty of the rendered pairs."""

    width_px: int = 400
    height_px: int = 300
    min_disparity_px: float = 6.0  # of what is farthest, about
    max_disparity_px: float = 60.0  # of what is nearest, about
    noise_levels: float = 2.0  # standard deviation of the sensor noise, in grey levels, independent in both views
    gain: float = 0.97  # of view 1
    offset_levels: float = 2.0  # of view 1, in grey levels
    samples_per_px: int = 2  # rays along each axis of a pixel

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px", "samples_per_px"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.min_disparity_px < self.max_disparity_px:
            limits = f"{self.min_disparity_px} and {self.max_disparity_px}"
            raise ValueError(f"min_disparity_px must lie between 0 and max_disparity_px, got {limits}")
        if not self.noise_levels >= 0:
            raise ValueError(f"noise_levels must not be negative, got {self.noise_levels}")
        if not self.gain > 0:
            raise ValueError(f"gain must be positive, got {self.gain}")
