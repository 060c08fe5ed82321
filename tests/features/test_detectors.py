"""Laws that every detector and every backend obeys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tensor_stereo.configs import FASTConfig, GFTTConfig, PipelineConfig, SIFTConfig, SURFConfig
from tensor_stereo.features import detect_fast, detect_features, detect_gftt, detect_sift, detect_surf
from tensor_stereo.types import Features

CASES = {
    "fast": (detect_fast, FASTConfig(), 121),
    "fast-all": (detect_fast, FASTConfig(nonmax_suppression=False, window_px=5), 25),
    "gftt-kornia": (detect_gftt, GFTTConfig(), 121),
    "gftt-opencv": (detect_gftt, GFTTConfig(backend="opencv", window_px=7), 49),
    "sift-kornia": (detect_sift, SIFTConfig(max_keypoints=60), 128),
    "sift-opencv": (detect_sift, SIFTConfig(backend="opencv"), 128),
    "sift-opencv-upright": (detect_sift, SIFTConfig(backend="opencv", upright=True), 128),
    "surf": (detect_surf, SURFConfig(), 64),
}
detectors = pytest.mark.parametrize(("detect", "config", "size"), CASES.values(), ids=CASES)
Detect = Callable[[Tensor, Any], Features]


def columns(features: Features) -> tuple[Tensor, ...]:
    return features.keypoints, features.descriptors, features.scores


def equal(a: Features, b: Features) -> bool:
    return torch.equal(a.ptr, b.ptr) and all(map(torch.equal, columns(a), columns(b)))


@detectors
def test_features_are_well_formed(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    features = detect(textures, config)
    assert (features.ptr.diff() >= 10).all()
    assert features.descriptors.shape[1] == size
    assert {values.dtype for values in columns(features)} == {torch.float32}
    assert not any(values.requires_grad for values in columns(features))
    height, width = textures.shape[2:]
    assert ((features.keypoints >= 0) & (features.keypoints <= torch.tensor([width - 1, height - 1]))).all()


@detectors
def test_batch_equals_loop_bit_for_bit(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    batch = detect(textures, config)
    for b, image in enumerate(textures):
        alone = detect(image[None], config)
        rows = slice(int(batch.ptr[b]), int(batch.ptr[b + 1]))
        assert all(torch.equal(x[rows], y) for x, y in zip(columns(batch), columns(alone), strict=True))


@detectors
def test_keypoints_are_ordered_by_strength_then_row_then_column(
    detect: Detect, config: Any, size: int, textures: Tensor
) -> None:
    features = detect(textures[:1], config)
    keys = [(-s, y, x) for s, (x, y) in zip(features.scores.tolist(), features.keypoints.tolist(), strict=True)]
    assert keys == sorted(keys)


@detectors
def test_fewer_keypoints_are_the_strongest_of_more(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    more = detect(textures[:1], config)
    fewer = detect(textures[:1], replace(config, max_keypoints=7))
    kept = len(fewer.keypoints)
    merged = isinstance(config, SIFTConfig) and config.backend == "opencv" and config.upright
    assert 0 < kept <= 7 if merged else kept == 7  # OpenCV counts orientations, which are merged afterwards
    assert torch.equal(more.keypoints[:kept], fewer.keypoints)
    assert torch.equal(more.scores[:kept], fewer.scores)
    # kornia describes keypoints in blocks, and sums of unit vectors' entries depend on the block by a few roundings
    torch.testing.assert_close(more.descriptors[:kept], fewer.descriptors, rtol=0, atol=1e-6)


@detectors
def test_floats_and_gray_colour_change_nothing(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    expected = detect(textures[:1], config)
    assert equal(detect(textures[:1] / 255, config), expected)
    assert equal(detect(textures[:1].expand(1, 3, -1, -1), config), expected)


@detectors
@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 2), (3, 3), (4, 4), (5, 5), (7, 7), (12, 13), (1, 60), (60, 1), (4, 200)]
)
def test_tiny_images_are_no_error(detect: Detect, config: Any, size: int, shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 256, (2, 1, *shape), generator=generator, dtype=torch.uint8)
    features = detect(noise, config)
    assert features.num_images == 2
    assert features.descriptors.shape[1] == size
    if shape == (1, 1):
        assert len(features.keypoints) == 0


@detectors
def test_image_without_texture_has_no_keypoints(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    blank = torch.full_like(textures[:1], 90)
    features = detect(torch.cat([blank, textures[:1], blank]), config)
    assert features.ptr.diff().tolist() == [0, len(features.keypoints), 0]
    assert detect(blank, config).descriptors.shape == (0, size)


@detectors
def test_batch_without_images_has_no_keypoints(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    features = detect(textures[:0], config)
    assert features.ptr.tolist() == [0]
    assert features.descriptors.shape == (0, size)


@detectors
def test_unfit_arguments_are_named(detect: Detect, config: Any, size: int, textures: Tensor) -> None:
    with pytest.raises(ValueError, match="images must have shape"):
        detect(textures[0], config)
    with pytest.raises(ValueError, match=f"{type(config).__name__}.max_keypoints must lie in"):
        replace(config, max_keypoints=0)
    if hasattr(config, "backend"):
        with pytest.raises(ValueError, match=f"{type(config).__name__}.backend must be one of kornia, opencv, got 'x'"):
            replace(config, backend="x")
    if hasattr(config, "window_px"):
        with pytest.raises(ValueError, match=f"{type(config).__name__}.window_px must be odd"):
            replace(config, window_px=4)


@pytest.mark.parametrize(
    ("detector", "detect"),
    [("fast", detect_fast), ("gftt", detect_gftt), ("sift", detect_sift), ("surf", detect_surf)],
)
def test_dispatch_runs_the_named_detector_with_its_settings(detector: Any, detect: Any, textures: Tensor) -> None:
    config = PipelineConfig(detector=detector)
    own = replace(getattr(config, detector), max_keypoints=20)
    config = replace(config, **{detector: own})
    assert equal(detect_features(textures[:1], config), detect(textures[:1], own))


def test_dispatch_names_an_unknown_detector(textures: Tensor) -> None:
    with pytest.raises(ValueError, match="detector must be one of sift, fast, surf, gftt, got 'orb'"):
        detect_features(textures, PipelineConfig(detector="orb"))  # type: ignore[arg-type]


def test_module_has_no_other_attributes() -> None:
    import tensor_stereo.features

    with pytest.raises(AttributeError, match="has no attribute 'detect_orb'"):
        tensor_stereo.features.detect_orb  # noqa: B018
