"""What others would use for the same job, each as a score of given putative matches; higher is more likely correct."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from kornia.feature.adalam import AdalamFilter, get_adalam_default_config
from scipy.spatial import Delaunay, cKDTree

from accuracy.putatives import RATIO, Bool, Float, Putatives

PeerScore = Callable[[Putatives], Float]

GMS_THRESHOLD = 6.0
MAGSAC_ERROR_PX, MAGSAC_CONFIDENCE, MAGSAC_ITERATIONS = 1.0, 0.999, 10_000
LPM_NEIGHBORS, LPM_COSINE, LPM_COST = (4, 6, 8), 0.2, 0.8
FLOW_DIFFERENCE_PX = 5.0  # libviso2
NUM_NEIGHBORS = 8


def qhull_adjacency(points: Float) -> Bool:
    """(M, M) edges of Qhull's triangulation, with its choice of diagonals."""
    corners = Delaunay(points).simplices
    edges = np.zeros((len(points), len(points)), bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edges[corners[:, a], corners[:, b]] = True
    return edges | edges.T


def score_restrictions(given: Putatives) -> dict[str, Float]:
    """The paper's two restrictions, one bit each, and the Jaccard index of the same neighbour sets."""
    edges0, edges1 = qhull_adjacency(given.points0), qhull_adjacency(given.points1)
    degree0, degree1, overlap = edges0.sum(1), edges1.sum(1), (edges0 & edges1).sum(1)
    return {
        "paper R1": ((overlap == degree0) & (overlap == degree1)).astype(float),
        "paper R1+R2": (overlap == np.minimum(degree0, degree1)).astype(float),
        "Jaccard of neighbours": overlap / np.maximum(degree0 + degree1 - overlap, 1),
    }


def score_gms(given: Putatives) -> Float:
    """Grid-based motion statistics (Bian et al., CVPR 2017), OpenCV's; one bit."""
    views = ([cv2.KeyPoint(float(x), float(y), 1) for x, y in p] for p in (given.points0, given.points1))
    rows = [cv2.DMatch(i, i, 0.0) for i in range(len(given.points0))]
    size = given.size[::-1]
    kept = cv2.xfeatures2d.matchGMS(size, size, *views, rows, False, False, GMS_THRESHOLD)
    score = np.zeros(len(rows))
    score[[match.queryIdx for match in kept]] = 1
    return score


def score_magsac(given: Putatives) -> Float:
    """Inliers of a fundamental matrix by MAGSAC++ (Barath et al., CVPR 2020), OpenCV's; one bit."""
    options = cv2.USAC_MAGSAC, MAGSAC_ERROR_PX, MAGSAC_CONFIDENCE, MAGSAC_ITERATIONS
    _, inlier = cv2.findFundamentalMat(given.points0, given.points1, *options)
    return np.ones(len(given.points0)) if inlier is None else inlier.ravel().astype(float)


def score_residuals(given: Putatives, model: str) -> Float:
    """Minus the distance in px from a model by MAGSAC++, OpenCV's, with its inliers as above.

    That is Sampson's distance for a ``fundamental`` matrix, and the larger distance of both views for a ``homography``.
    """
    options = cv2.USAC_MAGSAC, MAGSAC_ERROR_PX, MAGSAC_CONFIDENCE, MAGSAC_ITERATIONS
    find = cv2.findFundamentalMat if model == "fundamental" else _find_homography
    matrix, _ = find(given.points0, given.points1, *options)
    if matrix is None:
        return np.zeros(len(given.points0))
    left, right = (np.concatenate([points, np.ones((len(points), 1))], 1) for points in (given.points0, given.points1))
    if model == "fundamental":
        ahead, back = left @ matrix.T, right @ matrix
        gradient = (ahead[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
        return -np.abs((right * ahead).sum(1)) / np.sqrt(gradient.clip(1e-12))
    shown, back = left @ matrix.T, right @ np.linalg.inv(matrix).T
    misses = [x[:, :2] / x[:, 2:] - y[:, :2] for x, y in ((shown, right), (back, left))]
    return -np.nan_to_num(np.max([np.linalg.norm(miss, axis=1) for miss in misses], 0), nan=1e9, posinf=1e9)


def _find_homography(points0: Float, points1: Float, method: int, error_px: float, confidence: float, rounds: int):
    return cv2.findHomography(points0, points1, method, error_px, None, rounds, confidence)


def score_lpm(given: Putatives) -> Float:
    """Locality preserving matching (Ma et al., IJCV 127, 2019): minus its cost, multi-scale, two rounds."""
    motion = given.points1 - given.points0
    length = np.linalg.norm(motion, axis=1)

    def cost_among(kept: Bool) -> Float:
        rows = np.flatnonzero(kept)
        total = np.zeros(len(motion))
        trees = [cKDTree(points[rows]) for points in (given.points0, given.points1)]
        for size in LPM_NEIGHBORS:
            near0, near1 = (
                rows[tree.query(points, size + 1)[1]]
                for tree, points in zip(trees, (given.points0, given.points1), strict=True)
            )  # (M, size + 1), with the match itself if it is kept
            own = np.arange(len(motion))[:, None]
            is_near0 = (near0 != own) & (np.cumsum(near0 != own, 1) <= size)
            shared = is_near0 & ((near0[:, :, None] == near1[:, None]) & (near1 != own)[:, None]).any(2)
            lengths, others = length[:, None], length[near0]
            cosine = (motion[:, None] * motion[near0]).sum(2) / (lengths * others + 1e-9)
            closeness = cosine * np.minimum(lengths, others) / np.maximum(np.maximum(lengths, others), 1e-9)
            total += (size - shared.sum(1) + (shared & (closeness < LPM_COSINE)).sum(1)) / size
        return total / len(LPM_NEIGHBORS)

    cost = cost_among(np.ones(len(motion), bool))
    kept = cost <= LPM_COST
    return -(cost_among(kept) if kept.sum() > 10 else cost)


def score_disparity(given: Putatives) -> dict[str, Float]:
    """Neighbours of the left view: libviso2's support rule (Geiger et al., IV 2011), and medians of disparities."""
    edges, disparity = qhull_adjacency(given.points0), (given.points0 - given.points1)[:, 0]
    motion = given.points1 - given.points0
    alike = np.abs(motion[:, None] - motion[None]).sum(2) < FLOW_DIFFERENCE_PX
    between = np.where(edges, np.abs(disparity[:, None] - disparity[None]), np.nan)
    between[~edges.any(1)] = np.ptp(disparity)  # Qhull leaves out points that coincide within its rounding
    _, near = cKDTree(given.points0).query(given.points0, NUM_NEIGHBORS + 1)
    return {
        "libviso2 support": (alike & edges).sum(1) / np.maximum(edges.sum(1), 1),
        "disparity median, Delaunay": -np.nanmedian(between, 1),
        "disparity median, 8-NN": -np.abs(disparity - np.median(disparity[near[:, 1:]], 1)),
    }


def score_adalam(given: Putatives) -> Float:
    """AdaLAM (Cavalli et al., ECCV 2020), kornia's, without orientations and scales: its confidence, 0 if rejected."""
    config = get_adalam_default_config()
    config |= {"orientation_difference_threshold": None, "scale_rate_threshold": None, "force_seed_mnn": False}
    points = [torch.from_numpy(p).float() for p in (given.points0, given.points1)]
    # It starts from the matches of the best ratio nearby; where none is known, from any.
    unknown = np.random.default_rng(0).uniform(0, RATIO, len(given.ratio))
    ratio = torch.from_numpy(np.where(np.isnan(given.ratio), unknown, given.ratio)).float()
    torch.manual_seed(0)
    size = given.size[::-1]
    rows, inverse = AdalamFilter(config).filter_matches(
        *points, torch.arange(len(ratio)), ratio.square(), None, size, size, return_dist=True
    )
    score = np.zeros(len(ratio))
    score[rows[:, 0].numpy()] = 1 / inverse.numpy().ravel().clip(1e-9).astype(float)
    return score


def score_peers(given: Putatives) -> dict[str, Float]:
    """All peers; every score is finite."""
    scores = score_restrictions(given)
    scores |= {"GMS": score_gms(given), "MAGSAC++ F": score_magsac(given), "LPM": score_lpm(given)}
    scores |= score_disparity(given)
    scores["AdaLAM"] = score_adalam(given)
    return scores
