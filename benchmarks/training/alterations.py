"""Random changes of the images of a pair: mirrored, resized, cropped, blurred, with other exposure and noise."""

from __future__ import annotations

import cv2
import numpy as np

from training.scenes import Gray, Views


def alter(views: Views, rng: np.random.Generator) -> Views:
    """Mirror, turn over, resize, crop, and change noise, blur and exposure, each with some probability."""
    views = reshape(views, rng)
    if rng.random() < 0.5:
        image0, image1 = expose(*views[:2], rng)
        views = views._replace(image0=image0, image1=image1)
    return views


def reshape(views: Views, rng: np.random.Generator) -> Views:
    """Mirror, turn over, resize, crop, each with some probability."""
    image0, image1, disparity0, disparity1 = views
    if disparity1 is not None and rng.random() < 0.4:  # mirrored views change places
        image0, image1, disparity0 = image1[:, ::-1], image0[:, ::-1], disparity1[:, ::-1]
    if rng.random() < 0.4:
        image0, image1, disparity0 = image0[::-1], image1[::-1], disparity0[::-1]
    image0, image1, disparity0 = (np.ascontiguousarray(x) for x in (image0, image1, disparity0))
    height, width = image0.shape
    if rng.random() < 0.4:
        scale = min(float(np.exp(rng.uniform(np.log(0.7), np.log(2.0)))), max(1000 / width, 0.7))
        size = round(width * scale), round(height * scale)
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        image0, image1 = (cv2.resize(x, size, interpolation=how) for x in (image0, image1))
        disparity0 = cv2.resize(disparity0, size, interpolation=cv2.INTER_NEAREST) * np.float32(size[0] / width)
        width, height = size
    if rng.random() < 0.3:
        rows, columns = int(height * rng.uniform(0.5, 1)), int(width * rng.uniform(0.6, 1))
        y, x = rng.integers(0, height - rows + 1), rng.integers(0, width - columns + 1)
        image0, image1, disparity0 = (a[y : y + rows, x : x + columns] for a in (image0, image1, disparity0))
    return Views(image0, image1, disparity0, None)


def expose(image0: Gray, image1: Gray, rng: np.random.Generator, *, least_noise: float = 0.0) -> tuple[Gray, Gray]:
    """Blur both, give view 1 the response and exposure of another sensor, add noise, each with some probability.

    The noise of both is independent, of a standard deviation of at least ``least_noise`` grey levels.
    """
    levels = [x.astype(np.float32) for x in (image0, image1)]
    if rng.random() < 0.3:
        blur_px = rng.uniform(0.3, 1.0)
        levels = [cv2.GaussianBlur(x, (0, 0), blur_px) for x in levels]
    if rng.random() < 0.2:  # the response of another sensor
        levels[1] = 255 * (levels[1] / 255) ** np.exp(rng.normal(0, 0.1))
    levels[1] = np.exp(rng.normal(0, 0.08)) * levels[1] + rng.normal(0, 5)
    noise = rng.uniform(0, 4) if rng.random() < 0.6 else 0
    noise = max(noise, least_noise)
    noisy = (x + noise * rng.normal(0, 1, x.shape) for x in levels)
    image0, image1 = (np.clip(np.rint(x), 0, 255).astype(np.uint8) for x in noisy)
    return image0, image1
