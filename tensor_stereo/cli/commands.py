"""What each subcommand takes. Imports no torch, so that ``--help`` answers at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tensor_stereo.configs import EvaluationConfig, FileFilterConfig, PipelineConfig
from tensor_stereo.datasets.download.releases import RELEASES
from tensor_stereo.paths import TABLES, has_ending

Flat = tyro.conf.arg(name="")


@dataclass(frozen=True)
class Demo:
    """Classify the embedded synthetic set: the paper's tables, with the verdict of the score beside them."""

    num_pairs: int = 4
    """Pairs to render."""
    seed: int = 0
    """Seed of the rendered scenes."""
    out: Path | None = None
    """Folder for summary.json, settings.json, the tables and one figure per scene and detector."""


@dataclass(frozen=True)
class Classify:
    """Match the images of one pair and decide which matches are right."""

    left: tyro.conf.Positional[Path]
    """Image of view 0."""
    right: tyro.conf.Positional[Path]
    """Image of view 1."""
    disparity_gt: Path | None = None
    """Ground-truth disparity of view 0: PFM, 8-bit or 16-bit PNG."""
    gt_scale: float | None = None
    """Stored value / px of disparity in a PNG map."""
    sample_bits: int | None = None
    """Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell."""
    out: Path | None = None
    """Table of matches and verdicts, .csv or .parquet."""
    figure: Path | None = None
    """PNG of both views, their matches by the verdicts and their graphs."""
    config: Annotated[PipelineConfig, Flat] = field(default_factory=PipelineConfig)


@dataclass(frozen=True)
class Confidence:
    """How likely is every pixel of a disparity map right, whichever method made it?

    For one map, or for all maps that a manifest or a list of pairs names in its column disparity_est; a call that ended
    early goes on where it was.
    """

    left: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="LEFT", help="Image of view 0, rectified; or a manifest, .parquet or .csv, alone."),
    ]
    right: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RIGHT]", help="Image of view 1.")] = (
        None
    )
    disparity: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="[DISPARITY]", help="Map of view 0, x0 - x1 in px: .pfm, .png, .npy or .tiff."),
    ] = None
    disparity1: Path | None = None
    """Map of view 1 in the same form, which makes the result better."""
    scale: float | None = None
    """Stored value / px of both maps, which integers need: 256 for KITTI, 16 for what OpenCV's matchers return."""
    unknown: float | None = None
    """Stored value of an unknown disparity, besides 0 of a PNG, NaN and infinity."""
    max_error_px: float = 1.0
    """A pixel is right if its error is at most this, .5 to 12 px,"""
    max_error_share: float = 0.0
    """or at most this share of its estimate. KITTI's rule is --max-error-px 3 --max-error-share 0.05."""
    stride: int = 1
    """Distance in px of the pixels that are judged."""
    threshold: float | None = None
    """Least probability of a kept pixel; 0.5 if not given."""
    min_precision: float | None = None
    """Keep as many pixels as this expected precision allows, instead."""
    disparity_gt: Path | None = None
    """Ground-truth disparity of view 0: PFM, 8-bit or 16-bit PNG."""
    gt_scale: float | None = None
    """Stored value / px of disparity in a PNG of ground truth."""
    sample_bits: int | None = None
    """Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell."""
    out: Path | None = None
    """File of the probabilities: .pfm, .png (16 bits, 65535 is 1), .npy or .tiff. For a manifest the folder of such
    files, one per pair, and of confidence.parquet, one row per pair."""
    ending: Literal[".png", ".pfm", ".npy", ".tiff"] | None = None
    """Of the files in that folder; .png if not given."""
    workers: int | None = None
    """Maps of a manifest at a time, in processes of one thread; one, with all threads, if not given."""
    shard: str | None = None
    """i/n: the i-th of n parts of a manifest, as for an array of jobs."""
    figure: Path | None = None
    """PNG of the map, its confidence, what is kept and, with ground truth, its errors."""

    @property
    def is_manifest(self) -> bool:
        return has_ending(self.left, TABLES)


@dataclass(frozen=True)
class Evaluate:
    """Classify every pair below a folder: the paper's tables, with the verdict of the score beside them."""

    root: tyro.conf.Positional[Path]
    """Folder with one or several stereo releases."""
    scenes: tuple[str, ...] | None = None
    """Scenes to evaluate, in any case; all if not given."""
    preset: Literal["default", "paper"] = "default"
    """paper: SIFT with ratio 0.6, as in Lowe's demo program."""
    gt_scale: float | None = None
    """Stored value / px of disparity, where the folder layout does not tell it."""
    sample_bits: int | None = None
    """Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell."""
    out: Path | None = None
    """Folder for summary.json, settings.json, the tables and one figure per scene and detector."""
    config: Annotated[EvaluationConfig, Flat] = field(default_factory=EvaluationConfig)


@dataclass(frozen=True)
class Filter:
    """Decide which matches of a file are right, and write the file again with verdict and score.

    The same for all files of a folder, or of a list of paths; a call that ended early goes on where it was.
    """

    matches: tyro.conf.Positional[Path]
    """Putative matches: .npz, .csv, .parquet, .h5 of hloc, DISK or glue-factory, COLMAP's .db; or a folder of such
    files, or a .csv or .parquet list of them with the column matches."""
    out: Path
    """File to write, with the same ending; for a folder or a list the folder of the results."""
    keypoints: Path | None = None
    """File of keypoints that belongs to an .h5 of hloc or DISK."""
    score_name: str | None = None
    """Name of the score in .npz, .csv and .parquet: score, or filter_score beside a score of yours, if not given."""
    images: Path | None = None
    """Folder of the images, at which the score looks then: hloc, DISK and COLMAP name them; .csv and .parquet need the
    columns image0 and image1, .npz arrays of these names."""
    repair: bool = False
    """Search rejected matches, and keypoints without a partner, again where kept ones say; needs --images."""
    refine: bool = False
    """Move kept matches to where the images fit best, to a fraction of a pixel; needs --images."""
    config: Annotated[FileFilterConfig, Flat] = field(default_factory=FileFilterConfig)


@dataclass(frozen=True)
class Download:
    """Fetch published stereo releases and unpack them; a broken download goes on where it stopped."""

    releases: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(help=f"Any of {', '.join(RELEASES)}.")]
    out: Path = Path("data")
    """Folder for all of them."""
    base_url: str | None = None
    """Mirror, which replaces scheme and host of every address."""


@dataclass(frozen=True)
class Index:
    """List the pairs of folders and CSV files in one Parquet table, the manifest."""

    roots: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with stereo releases, or CSV files with the columns image0 and image1."""
    out: Path = Path("manifest.parquet")
    """Parquet file to write."""
    gt_scale: float | None = None
    """Stored value / px of disparity, where the folder layout does not tell it."""
    sample_bits: int | None = None
    """Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell."""


@dataclass(frozen=True)
class Render:
    """Write pairs of the synthetic set, with exact ground truth and a list for index."""

    out: tyro.conf.Positional[Path]
    """Folder for the images, the maps and synthetic.csv."""
    num_pairs: int = 8
    """Pairs to render."""
    seed: int = 0
    """Seed of the rendered scenes."""


@dataclass(frozen=True)
class Report:
    """Write the report of a sweep, or of two that it compares, as HTML and Markdown."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """One run folder, or two: differences are second - first."""
    out: Path | None = None
    """Folder for report.html and report.md; the last run folder if not given."""


@dataclass(frozen=True)
class Sweep:
    """Run every pair of a manifest through a grid of settings; a run that ended early goes on where it was."""

    settings: tyro.conf.Positional[Path]
    """TOML file with the grid."""
    manifest: str
    """Parquet file that index wrote, a folder of such files, or a CSV list of pairs; also by a URL of fsspec."""
    out: Path
    """Run folder."""
    engine: Literal["local", "ray"] = "local"
    """Processes on this machine, or a Ray cluster."""
    workers: int | None = None
    """Units at a time; one per core if not given."""
    ray_address: str | None = None
    """Of a running Ray cluster."""
    shard: str = "1/1"
    """i/n: the i-th of n parts of the sweep, as for an array of jobs."""
    limit: int | None = None
    """Units to do now, at most."""
    retry_errors: bool = False
    """Do failed units again."""
    seconds_per_part: float = 10.0
    """Time that a finished unit waits at most until it is stored."""
    verify: bool = False
    """Hash the finished parts instead of trusting their size."""
    dry_run: bool = False
    """Print what would run, and what it costs on one pair, and stop."""
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = "INFO"
    """Of log.jsonl in the run folder."""
