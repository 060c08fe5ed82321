"""From images to verdicts with every score, against what others do with the same images; the evidence against torch.

    python benchmarks/speed/images.py

The pairs are the eight scenes of the paper and one KITTI pair of the data folder. StereoSGBM: block 5, P1 200, P2 800,
128 disparities, no post-processing, both images padded on the left by 128 replicated columns so that every pixel has
all disparities. CPU time stands beside wall time in the results.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from kornia.feature.adalam import AdalamFilter, get_adalam_default_config

from tensor_stereo.configs import FilterConfig, MatchingConfig, PipelineConfig
from tensor_stereo.dense import filter_disparity
from tensor_stereo.features import to_gray
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.modules import DelaunayFilter
from tensor_stereo.pipeline import Stopwatch, match_pairs, run_pipeline, to_gray_pairs
from tensor_stereo.scores import measure_images, refine_matches, repair_matches, score_matches
from tensor_stereo.scores.alignment import estimate_alignment
from tensor_stereo.types import Matches

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_batch
from shared.scenes import GATES, read_eight, read_pairs
from speed.pipeline import naive

Views = list[tuple[torch.Tensor, torch.Tensor]]
DISPARITIES, STRIDE = 128, 4
GATED = replace(GATES, max_disparity_px=float(DISPARITIES))


def semi_global(images: list[tuple[np.ndarray, np.ndarray]], mode: int, *, both: bool) -> list[np.ndarray]:
    """Disparity maps of OpenCV; of both views for the left-right check, the second from mirrored images."""
    matcher = cv2.StereoSGBM.create(0, DISPARITIES, 5, P1=200, P2=800, mode=mode)
    maps = []
    for left, right in images:
        views = [(left, right)] + ([(right[:, ::-1], left[:, ::-1])] if both else [])
        for a, b in views:
            padded = [cv2.copyMakeBorder(x, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for x in (a, b)]
            maps.append(matcher.compute(*padded)[:, DISPARITIES:])
    return maps


def adalam(pairs: Views, config: PipelineConfig) -> None:
    """kornia's AdaLAM on the same FAST matches, one pair after the other, without orientations and scales."""
    options = get_adalam_default_config()
    options |= {"orientation_difference_threshold": None, "scale_rate_threshold": None, "force_seed_mnn": False}
    run = AdalamFilter(options)
    for pair in pairs:
        matches = match_pairs(to_gray_pairs([pair]), config, Stopwatch())
        points = matches.keypoints0.float(), matches.keypoints1.float()
        size = tuple(reversed(pair[0].shape[-2:]))
        rows = torch.arange(matches.num_matches)
        run.filter_matches(*points, rows, (matches.cost + 1).float(), None, size, size)


def pipeline(pairs: Views, score: str, matching: MatchingConfig) -> Callable[[], object]:
    verdict = "score" if score in ("learned", "consensus") else "cardinality"
    config = PipelineConfig(detector="fast", score=score, verdict=verdict, matching=matching)  # type: ignore[arg-type]
    return lambda: run_pipeline(pairs, config)


def compare_pipelines(suite: Suite, title: str, pairs: Views, arrays: list[tuple[np.ndarray, np.ndarray]]) -> None:
    cases: dict[str, Callable[[], object]] = {"learned": pipeline(pairs, "learned", MatchingConfig())}
    cases |= {f"{score}": pipeline(pairs, score, MatchingConfig()) for score in ("consensus", "topology", "none")}
    cases |= {f"{score}, gated": pipeline(pairs, score, GATED) for score in ("learned", "consensus", "none")}
    better = PipelineConfig(detector="fast", repair=True, refine=True)
    cases["learned, repaired and refined"] = lambda: run_pipeline(pairs, better)
    modes = {"SGBM": cv2.STEREO_SGBM_MODE_SGBM, "SGBM 3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY}
    for name, mode in modes.items():
        cases[name] = partial(semi_global, arrays, mode, both=False)
        cases[f"{name}, both views"] = partial(semi_global, arrays, mode, both=True)
    cases["AdaLAM"] = partial(adalam, pairs, PipelineConfig(detector="fast"))
    cases["OpenCV + NumPy + scipy + sets"] = lambda: naive(arrays)
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        suite.compare(f"images to verdicts, FAST, {title}, per pair", cases, threads=threads, units=len(pairs))


def compare_evidence(suite: Suite, title: str, pairs: Views, matches: Matches) -> None:
    """The operators on windows, both back ends, and the network."""
    graphs = build_match_graphs(matches)
    views = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    found = score_matches(matches, FilterConfig(), graphs, images=views)
    kept = found.score >= 0.5
    for threads in (1, 2):
        calls = {
            "evidence": partial(measure_images, *views, matches, graphs, found.alignment),
            "repair": partial(repair_matches, matches, *views, kept, found.alignment),
            "refinement": partial(refine_matches, matches, *views, kept, found.alignment, graphs),
        }
        for name, call in calls.items():
            cases = {backend: partial(call, backend=backend) for backend in ("native", "scipy")}
            units = len(pairs)
            suite.compare(f"{name}, {title}, per pair", cases, threads=threads, units=units, repeats=5)
    suite.note(f"matches, {title}", per_pair=matches.num_matches / len(pairs), kept=int(kept.sum()) / len(pairs))


def compare_grid(suite: Suite, pairs: Views, arrays: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Every fourth pixel of a semi-global map of one KITTI pair."""
    disparity = torch.from_numpy(semi_global(arrays[:1], cv2.STEREO_SGBM_MODE_SGBM, both=False)[0] / 16.0)
    disparity = disparity.where(disparity >= 0, torch.nan)[None, None].float()
    views = pairs[0][0][None], pairs[0][1][None]
    run = DelaunayFilter()
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        cases = {
            "filter_disparity, learned": lambda: filter_disparity(
                disparity, STRIDE, filter=run, images0=views[0], images1=views[1]
            ),
            "SGBM": partial(semi_global, arrays[:1], cv2.STEREO_SGBM_MODE_SGBM, both=False),
        }
        suite.compare(f"stride {STRIDE} of a KITTI map", cases, threads=threads, repeats=5)


def compare_bare(suite: Suite) -> None:
    """Without images, beside the hard verdict."""
    matches = matched_batch("float", 64, 1000)
    hard, soft = DelaunayFilter(score="none", verdict="cardinality"), DelaunayFilter()
    cases = {"classify": lambda: hard(matches), "learned": lambda: soft(matches)}
    cases["alignment alone"] = lambda: estimate_alignment(matches, build_match_graphs(matches), rectified=True)
    for threads in (1, 2):
        suite.compare("64 pairs x 1000 matches without images", cases, threads=threads, units=64, repeats=7)


@torch.inference_mode()
def main() -> None:
    suite = Suite("images")
    source, found = read_eight(suite.options.data)
    pairs = [(to_gray(p.image0[None])[0], to_gray(p.image1[None])[0]) for p in found]
    arrays = [(a[0].numpy(), b[0].numpy()) for a, b in pairs]
    compare_pipelines(suite, source, pairs, arrays)
    config = PipelineConfig(detector="fast")
    matches = match_pairs(to_gray_pairs(pairs), config, Stopwatch())
    compare_evidence(suite, f"{source}, FAST", pairs, matches)
    if suite.options.data is not None:
        kitti = read_pairs(suite.options.data / "kitti2015")[:1]
        views = [(to_gray(p.image0[None])[0], to_gray(p.image1[None])[0]) for p in kitti]
        compare_grid(suite, views, [(a[0].numpy(), b[0].numpy()) for a, b in views])
    compare_bare(suite)
    seconds = run_pipeline(pairs, config).seconds
    suite.note("stages of learned in ms per pair", **{k: 1e3 * v / len(pairs) for k, v in seconds.items()})
    suite.write()


if __name__ == "__main__":
    main()
