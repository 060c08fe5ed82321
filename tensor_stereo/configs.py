"""Settings of every step, as frozen dataclasses with units in the field names, checked when made. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, get_args

from tensor_stereo.limits import Count, Fraction, NotNegative, Positive, Within, check_settings
from tensor_stereo.step_configs import FASTConfig as FASTConfig
from tensor_stereo.step_configs import GFTTConfig as GFTTConfig
from tensor_stereo.step_configs import MatchingConfig as MatchingConfig
from tensor_stereo.step_configs import ObjectsConfig as ObjectsConfig
from tensor_stereo.step_configs import SGBMConfig as SGBMConfig
from tensor_stereo.step_configs import SIFTConfig as SIFTConfig
from tensor_stereo.step_configs import SURFConfig as SURFConfig

Detector = Literal["sift", "fast", "surf", "gftt"]
Restriction = Literal["adjacency", "cardinality"]
Verdict = Literal["score", Restriction]
TemperatureUnit = Literal["edge", "px"]
Score = Literal["topology", "consensus", "learned"]
ResolvedScore = Literal["none", Score]  # none: no score, and no curve in the results
ScoreName = Literal["auto", ResolvedScore]
Backend = Literal["auto", "native", "scipy"]
Rectified = Literal[True, False, "auto"]

RESTRICTIONS: tuple[Restriction, ...] = get_args(Restriction)
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
SCORES: tuple[Score, ...] = get_args(Score)
CUTS = ("threshold", "target_sensitivity", "min_precision")  # ways from a score to a verdict; one may be given
LIKELY = 0.5  # probability from which a match is kept where no such way is given
PIPELINE_STAGES = ("detect", "match", "group", "graph", "relate", "score", "improve")
DETECTORS: tuple[Detector, ...] = ("sift", "fast", "surf", "gftt")  # order of the paper's Tables 1-4
LEAST_ERROR_PX, MOST_ERROR_PX = 0.5, 5.0  # tolerances between which a score is calibrated
COLDEST, HOTTEST = 1e-9, 1e9  # temperatures whose gradients are finite in float32 too

Tolerance = Annotated[float, Within(LEAST_ERROR_PX, MOST_ERROR_PX)]


@dataclass(frozen=True)
class ConsensusConfig:
    """Settings of the consensus score, of what the neighbours of a match believe.

    Two of them have a second value for keypoints on whole pixels, whose rounding is larger than the errors of sub-pixel
    keypoints; what lies between is interpolated. Which keypoints are given is measured, pair by pair.
    """

    tolerance_px: Positive = 0.6  # difference to a neighbour's plane at which agreement has fallen to exp(-1/2)
    whole_tolerance_px: Positive = 1.0  # the same for keypoints on whole pixels
    row_tolerance_px: Positive = 0.25  # offset from the row, or from the epipolar line, that halves the odds
    whole_row_tolerance_px: Positive = 1.5  # the same for keypoints on whole pixels
    slope: Positive = 0.2  # expected change of the displacement per px of distance, px/px
    reach: Positive = 2.0  # distance, in edge lengths around the match, at which a neighbour's vote counts half
    doubt: Positive = 1.0  # votes against every match, so that few votes are less than many
    cost_weight: NotNegative = 0.5  # log-odds per standard deviation of the logarithm of the cost
    num_rounds: Annotated[int, Within(1, 1000)] = 2  # of belief

    def __post_init__(self) -> None:
        check_settings(self, prefix="ConsensusConfig.")


@dataclass(frozen=True)
class FilterConfig:
    """What decides about every match, and the score beside it.

    The verdict is that of a score, or one of the paper's set tests on the two Delaunay graphs (Bustos et al. 2016,
    section 3): ``adjacency`` is its Restriction 1, ``cardinality`` its Restriction 2.

    A probability of at least .5 keeps a match under the verdict ``score``, unless one of ``threshold``,
    ``target_sensitivity`` and ``min_precision`` says otherwise. The score ``topology`` is a similarity, not a
    probability, and needs an explicit ``threshold``. A match is correct, and a probability is that of it, if its error
    is at most ``max_error_px``, in px of view 0.

    ``auto`` stands for ``learned`` under the verdict ``score``, and for no score under the verdicts of the paper, so
    that nobody pays for what is not asked. In :class:`tensor_stereo.DelaunayFilter` it stands for ``topology`` under
    the verdicts of the paper.

    ``consensus`` and ``learned`` take out what all matches of a pair share: the row offset of rectified pairs, whose
    partners lie on one row; of others rotation, scale and perspective, with the epipolar lines in the place of rows.

    Raises:
        ValueError: if a value lies outside of its limits, or settings contradict each other.
        TypeError: if a value has another type.
    """

    verdict: Verdict = "score"  # what decides: the score, or Restriction 1 or 2 of the paper
    score: ScoreName = "auto"  # auto: learned where the score decides, none elsewhere
    threshold: Fraction | None = None  # least score of a match that is kept
    target_sensitivity: Fraction | None = None  # fraction of the incorrect matches that are rejected, at least
    min_precision: Fraction | None = None  # fraction of the kept matches that are correct, at least
    max_error_px: Tolerance = 1.0  # a match is correct iff its error is at most that; a score is the probability of it
    rectified: Rectified = True  # whether partners lie on one row; auto: the matches of each pair tell
    min_group_size: Annotated[int, Within(1, 2**31 - 1)] = 4  # distinct matches below which a group says nothing
    tie_tolerance: Annotated[float, Within(0, 1, open_high=True)] = 1e-3  # in edge lengths
    temperature: Annotated[float, Within(COLDEST, HOTTEST)] = 1.0  # of the score topology
    temperature_unit: TemperatureUnit = "edge"  # edge: lengths of the edge at hand
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)  # of the score consensus
    backend: Backend = "auto"  # native: compiled kernels; scipy: graphs by scipy, all else by torch

    def __post_init__(self) -> None:
        check_settings(self)
        given = _check_cuts(self)
        if self.verdict != "score":
            for name in given:
                raise ValueError(f"{name} needs the verdict 'score', got {self.verdict!r} with {getattr(self, name)}")
        elif self.score == "none":
            raise ValueError("score must not be 'none' where the verdict is 'score'; name a score or another verdict")
        elif self.score == "topology" and self.threshold is None:
            other = f"; {given[0]} needs a probability" if given else ""
            raise ValueError(f"threshold must be given where the score is 'topology', which is no probability{other}")

    @property
    def resolved_score(self) -> ResolvedScore:
        """The score that is computed; what ``auto`` stands for.

        >>> FilterConfig().resolved_score, FilterConfig(verdict="cardinality").resolved_score
        ('learned', 'none')
        """
        if self.score != "auto":
            return self.score
        return "learned" if self.verdict == "score" else "none"

    @property
    def is_probability(self) -> bool:
        """Whether the score is a calibrated probability."""
        return self.resolved_score in ("consensus", "learned")


def _check_cuts(config: FilterConfig) -> list[str]:
    """The ways from a score to a verdict that are given; raises if there are several."""
    given = [name for name in CUTS if getattr(config, name) is not None]
    if len(given) > 1:
        raise ValueError(f"{given[1]} must be None beside {given[0]}, got {getattr(config, given[1])}")
    return given


@dataclass(frozen=True)
class FileFilterConfig(FilterConfig):
    """What decides about the matches of a file, whose pairs need not be rectified."""

    rectified: Rectified = "auto"  # whether partners lie on one row; auto: the matches of each pair tell


def describe_verdict(settings: Mapping[str, Any]) -> str:
    """What decides under some settings, in a few words; ``score`` is a resolved one.

    A tolerance of 1 px, and that of a score that is no probability, goes without saying.

    >>> describe_verdict({"verdict": "adjacency"}), describe_verdict({"verdict": "score", "score": "learned"})
    ('adjacency', 'learned, probability 0.5')
    """
    if settings["verdict"] != "score":
        return str(settings["verdict"])
    max_error_px = settings.get("max_error_px", 1)
    within = f" within {max_error_px:g} px" if max_error_px != 1 and settings["score"] != "topology" else ""
    for name in CUTS:
        if settings.get(name) is not None:
            return f"{settings['score']}, {name.replace('_', ' ')} {settings[name]:g}{within}"
    return f"{settings['score']}, probability {LIKELY:g}{within}"


def describe_settings(config: FilterConfig) -> str:
    """What decides under some settings, in a few words, as :func:`describe_verdict` says it of a row of results.

    >>> describe_settings(FilterConfig(min_precision=0.9, max_error_px=3))
    'learned, min precision 0.9 within 3 px'
    """
    return describe_verdict(vars(config) | {"score": config.resolved_score})


@dataclass(frozen=True)
class StepConfigs(FilterConfig):
    """Settings of all steps, whichever detector runs.

    Raises:
        ValueError: also if pairs may be other than rectified where the matches come from a semi-global map.
    """

    sift: SIFTConfig = field(default_factory=SIFTConfig)
    fast: FASTConfig = field(default_factory=FASTConfig)
    surf: SURFConfig = field(default_factory=SURFConfig)
    gftt: GFTTConfig = field(default_factory=GFTTConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    sgbm: SGBMConfig = field(default_factory=SGBMConfig)  # of the matching method sgbm
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    repair: bool = False  # search rejected matches, and keypoints without one, again where kept ones say
    refine: bool = False  # move kept matches to where the images fit best, to a fraction of a pixel

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.matching.method == "sgbm" and self.rectified is not True:
            raise ValueError(
                f"rectified must be True where MatchingConfig.method is 'sgbm', got {self.rectified!r}: "
                "semi-global matching looks for partners on the same row"
            )


@dataclass(frozen=True)
class PipelineConfig(StepConfigs):
    """From two images to verdicts."""

    detector: Detector = "fast"
    constrained: bool = False  # Restriction 3: split the matches by object first

    @property
    def resolved_matching(self) -> MatchingConfig:
        """The matcher's settings, with the ratio of the detector's own settings where the matcher's say none.

        Semi-global matching has no ratio.

        >>> PipelineConfig(detector="sift").resolved_matching.max_ratio
        0.8
        """
        if self.matching.method == "ssd" and self.matching.max_ratio is None and self.detector == "sift":
            return replace(self.matching, max_ratio=self.sift.max_ratio)
        return self.matching


@dataclass(frozen=True)
class TrialConfig(PipelineConfig):
    """One point of a sweep's grid: a pipeline, and what is done to its putative matches."""

    outlier_rate: Fraction = 0.0  # of the matches whose partners in view 1 change places among them
    noise_px: NotNegative = 0.0  # standard deviation added to x and y of both keypoints
    seed: Annotated[int, Within(0, 2**31 - 1)] = 0  # of outliers and noise, together with the name of the pair


@dataclass(frozen=True)
class SweepConfig:
    """The points of a grid, each of which every pair goes through."""

    trials: tuple[TrialConfig, ...] = (TrialConfig(),)
    export_matches: bool = False  # whether every match with its verdict is kept, for training

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.trials:
            raise ValueError("trials must hold at least one point")


@dataclass(frozen=True)
class EvaluationConfig(StepConfigs):
    """From pairs with ground truth to the paper's tables, with the verdict of the score beside them."""

    min_group_size: Annotated[int, Within(1, 2**31 - 1)] = 1  # 1: the paper read literally
    detectors: tuple[Detector, ...] = DETECTORS

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.detectors or len(set(self.detectors)) < len(self.detectors):
            given = ", ".join(self.detectors) or "none"
            raise ValueError(f"detectors must name at least one, and each once, got {given}")

    @property
    def restriction(self) -> Restriction:
        """The restriction of the paper that the tables show."""
        return "cardinality" if self.verdict == "score" else self.verdict

    def trials(self, detector: Detector) -> tuple[TrialConfig, ...]:
        """The same settings for one detector, under every verdict that the tables show.

        The verdict of the score, if it is wanted, on all matches; then both restrictions of the paper without, and
        last with Restriction 3.
        """
        shared = {f.name: getattr(self, f.name) for f in fields(StepConfigs)}
        trial = TrialConfig(**shared, detector=detector)
        trials = []
        if trial.verdict == "score":
            trials.append(trial)
            no_cuts: dict[str, Any] = dict.fromkeys(CUTS)
            trial = replace(trial, verdict=self.restriction, score="none", **no_cuts)
        trial = replace(trial, repair=False, refine=False)  # the paper's tables are of the matches as they come
        for constrained in (False, True):
            trials += [replace(trial, verdict=name, constrained=constrained) for name in RESTRICTIONS]
        return tuple(trials)


@dataclass(frozen=True)
class SyntheticConfig:
    """Size and difficulty of the rendered pairs."""

    width_px: Count = 400
    height_px: Count = 300
    min_disparity_px: Positive = 6.0  # of what is farthest, about
    max_disparity_px: Positive = 60.0  # of what is nearest, about
    noise_levels: Annotated[float, Within(0)] = (
        2.0  # standard deviation of the sensor noise, in grey levels, independent in both views
    )
    gain: Positive = 0.97  # of view 1
    offset_levels: float = 2.0  # of view 1, in grey levels
    samples_per_px: Count = 2  # rays along each axis of a pixel

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.min_disparity_px < self.max_disparity_px:
            limits = f"{self.min_disparity_px} and {self.max_disparity_px}"
            raise ValueError(f"min_disparity_px must be less than max_disparity_px, got {limits}")
