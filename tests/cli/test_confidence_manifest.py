"""Confidence of all maps that a manifest or a list names."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest
import torch
from polars.testing import assert_frame_equal
from torch.utils.data import DataLoader

from tensor_stereo.cli import main
from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets import build_manifest, read_manifest, write_manifest, write_pfm
from tensor_stereo.datasets.images import write_image
from tensor_stereo.datasets.map_files import read_map
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.dense import match_semi_global, score_disparity
from tensor_stereo.evaluation import sparsification_area
from tensor_stereo.reports import confidence_folder
from tensor_stereo.reports.confidence import RATES, ConfidenceSummary, score_disparity_files
from tensor_stereo.sweeps import ConfidenceDataset
from tests.cli.failing import fails

SCORE_IN_WORKER = confidence_folder._score_in_worker
COLUMNS = "dataset,scene,image0,image1,disparity_est,disparity1_est,est_scale,disparity_gt\n"


@pytest.fixture
def listed(tmp_path: Path) -> Path:
    """A list of three rendered pairs: KITTI's integers with truth, PFM with both maps, and PFM without truth."""
    lines = [COLUMNS]
    for k in range(3):
        pair = render_pair(k, SyntheticConfig(width_px=200, height_px=150))
        write_image(tmp_path / f"left{k}.png", pair.image0)
        write_image(tmp_path / f"right{k}.png", pair.image1)
        assert pair.disparity_gt is not None
        write_pfm(tmp_path / f"truth{k}.pfm", pair.disparity_gt.numpy())
        maps = match_semi_global(pair.image0, pair.image1)
        assert maps.disparity1 is not None
        for name, values in (("map", maps.disparity0[0]), ("map1", maps.disparity1[0])):
            write_pfm(tmp_path / f"{name}{k}.pfm", values.nan_to_num(torch.inf).numpy())
            stored = (values.nan_to_num(0).clamp(min=0) * 256).round().numpy().astype(np.uint16)
            cv2.imwrite(str(tmp_path / f"{name}{k}.png"), stored)
    lines += ["one,a b,left0.png,right0.png,map0.png,,256,truth0.pfm\n"]
    lines += ["two,deep/c,left1.png,right1.png,map1.pfm,map11.pfm,,truth1.pfm\n"]
    lines += ["two,d,left2.png,right2.png,map2.pfm,,,\n"]
    path = tmp_path / "maps.csv"
    path.write_text("".join(lines))
    return path


def test_each_pair_gives_what_it_gives_alone(listed: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    main(["confidence", str(listed), "--out", str(out), "--min-precision", "0.9", "--ending", ".npy", "--stride", "2"])
    printed = capsys.readouterr().out
    for text in ("| one ", "| all ", str(out / "confidence.parquet")):
        assert text in printed
    frame = pl.read_parquet(out / "confidence.parquet")
    assert frame.select("dataset", "scene").rows() == [("one", "a b"), ("two", "deep/c"), ("two", "d")]
    settings = {"stride": 2, "min_precision": 0.9}
    for row, (k, given) in enumerate([
        (0, {"disparity": "map0.png", "scale": 256, "disparity_gt": "truth0.pfm"}),
        (1, {"disparity": "map1.pfm", "disparity1": "map11.pfm", "disparity_gt": "truth1.pfm"}),
        (2, {"disparity": "map2.pfm"}),
    ]):  # fmt: skip
        views = [tmp_path / f"{side}{k}.png" for side in ("left", "right")]
        paths = {name: tmp_path / v if isinstance(v, str) else v for name, v in given.items()}
        alone = tmp_path / "alone.npy"
        summary = score_disparity_files(*views, **settings, out=alone, **paths)  # type: ignore[arg-type]
        name = "/".join(frame.row(row)[:2])
        assert (out / f"{name}.npy").read_bytes() == alone.read_bytes()
        assert frame["num_kept"][row] == summary.num_kept
        assert {name: frame[name][row] for name in RATES} == dict.fromkeys(RATES) | summary.rates


def test_rates_are_those_of_the_errors(listed: Path, tmp_path: Path) -> None:
    views = [tmp_path / f"{side}0.png" for side in ("left", "right")]
    summary = score_disparity_files(
        *views, tmp_path / "map0.pfm", disparity_gt=tmp_path / "truth0.pfm", out=tmp_path / "c.npy", max_error_px=2
    )
    pair = render_pair(0, SyntheticConfig(width_px=200, height_px=150))
    error = (match_semi_global(pair.image0, pair.image1).disparity0[0] - pair.disparity_gt).abs()
    probability = torch.from_numpy(np.load(tmp_path / "c.npy"))
    judged = error.isfinite()
    for px in (0.5, 1.0, 2.0, 3.0, 4.0):
        assert summary.rates[f"bad_{px:g}px"] == float((error[judged] > px).double().mean())
    assert summary.rates["bad"] == summary.rates["bad_2px"]
    kept = judged & (probability >= 0.5)
    assert summary.rates["epe_px_kept"] == pytest.approx(float(error[kept].double().mean()), rel=1e-12)
    wrong = error[judged] > 2
    assert summary.rates["sparsification"] == sparsification_area(probability[judged], wrong)
    assert summary.rates["sparsification_optimum"] <= summary.rates["sparsification"]


def test_it_goes_on_where_it_was(listed: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    manifest, out = tmp_path / "maps.parquet", tmp_path / "out"
    write_manifest(build_manifest([listed]), manifest)
    assert [pair.est_scale for pair in read_manifest(manifest)] == [256.0, None, None]
    hidden = tmp_path / "map2.pfm"
    hidden.rename(tmp_path / "away.pfm")
    with pytest.raises(SystemExit) as stop:
        main(["confidence", str(manifest), "--out", str(out)])
    assert stop.value.code == 1
    captured = capsys.readouterr()
    for text in ("two/d: disparity_est: there is no file", "1 of 3 pairs failed"):
        assert text in captured.err
    assert len(pl.read_parquet(out / "confidence.parquet")) == 2
    (tmp_path / "away.pfm").rename(hidden)
    summary = confidence_folder.score_disparity_manifest(manifest, out)
    assert (summary.num_pairs, summary.num_found, summary.errors) == (3, 2, {})
    (out / "one" / "a b.png").unlink()
    hidden.write_bytes((tmp_path / "map0.pfm").read_bytes())
    assert confidence_folder.score_disparity_manifest(manifest, out).num_found == 1
    with pytest.raises(ValueError, match="holds results of other settings"):
        confidence_folder.score_disparity_manifest(manifest, out, stride=2)


def test_another_scale_is_another_result(listed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    confidence_folder.score_disparity_manifest(listed, out)
    text = listed.read_text()
    listed.write_text(text.replace("256", "128"))
    again = confidence_folder.score_disparity_manifest(listed, out)
    assert (again.num_found, again.errors) == (2, {})
    changed = pl.read_parquet(out / "confidence.parquet")
    listed.write_text(text)
    first = confidence_folder.score_disparity_manifest(listed, out).frame
    assert changed["epe_px"][0] > 2 * first["epe_px"][0]
    assert changed[1:].equals(first[1:])


def test_files_that_are_away_for_a_while_take_no_result_with_them(listed: Path, tmp_path: Path) -> None:
    """As those of a disk that is not mounted."""
    out = tmp_path / "out"
    confidence_folder.score_disparity_manifest(listed, out)
    result = (out / "two" / "d.png").read_bytes()
    (tmp_path / "left2.png").rename(tmp_path / "away.png")
    summary = confidence_folder.score_disparity_manifest(listed, out)
    assert (summary.num_found, list(summary.errors)) == (2, ["two/d"])
    assert (out / "two" / "d.png").read_bytes() == result
    (tmp_path / "away.png").rename(tmp_path / "left2.png")
    assert confidence_folder.score_disparity_manifest(listed, out).num_found == 3


def test_maps_are_never_replaced(listed: Path, tmp_path: Path) -> None:
    (tmp_path / "two").mkdir()
    (tmp_path / "map0.png").rename(tmp_path / "two" / "d.png")
    listed.write_text(listed.read_text().replace("map0.png", "no/../two/d.png"))
    (tmp_path / "no").mkdir()
    with pytest.raises(ValueError, match="out must be another folder"):
        confidence_folder.score_disparity_manifest(listed, tmp_path)


def test_bad_manifests_are_one_line(listed: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = ["--out", str(tmp_path / "out")]
    command = ["confidence", str(listed)]
    fails(command, capsys, "--out", "folder")
    fails([*command, "right.png", *out], capsys, "RIGHT")
    fails([*command, *out, "--scale", "3"], capsys, "--scale", "est_scale")
    fails([*command, *out, "--disparity-gt", "a.pfm"], capsys, "--disparity-gt", "column")
    fails([*command, *out, "--figure", "a.png"], capsys, "--figure")
    fails([*command, *out, "--max-error-px", "0"], capsys, "--max-error-px")
    fails(["confidence", str(tmp_path / "left0.png")], capsys, "RIGHT", "manifest")
    alone = [str(tmp_path / name) for name in ("left0.png", "right0.png", "map0.pfm")]
    for option, value in (("--ending", ".npy"), ("--workers", "2"), ("--shard", "1/2")):
        fails(["confidence", *alone, option, value], capsys, option, "without a manifest")
    fails([*command, *out, "--workers", "0"], capsys, "--workers")
    fails([*command, *out, "--shard", "3/2"], capsys, "--shard")
    text = listed.read_text()
    for wrong, words in (
        (text.replace("map2.pfm", ""), ("two/d", "disparity_est")),
        (text.replace("256", "-1"), ("line 2", "est_scale")),
        (text.replace("a b", "../../a"), ("one/../../a", "below out")),
        (text.replace("two,deep/c", "two/.,d"), ("two/./d", "two/d", "one name")),
        (COLUMNS, ("lists no pair",)),
    ):
        listed.write_text(wrong)
        fails([*command, *out], capsys, *words)
    listed.write_text(text.replace("256", ""))
    with pytest.raises(SystemExit) as stop:
        main([*command, *out])
    assert stop.value.code == 1
    assert "one/a b: est_scale must be given" in capsys.readouterr().err


def maps_of(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*.npy")}


def test_workers_and_shards_give_what_one_call_gives(listed: Path, tmp_path: Path) -> None:
    alone = confidence_folder.score_disparity_manifest(listed, tmp_path / "one", ending=".npy", stride=4)
    command = ["confidence", str(listed), "--ending", ".npy", "--stride", "4"]
    main([*command, "--out", str(tmp_path / "two"), "--workers", "2"])
    for shard in ("2/2", "1/2"):
        main([*command, "--out", str(tmp_path / "three"), "--shard", shard])
    whole = confidence_folder.score_disparity_manifest(listed, tmp_path / "three", ending=".npy", stride=4)
    assert whole.num_found == 3
    for out in (tmp_path / "two", tmp_path / "three"):
        assert maps_of(out).keys() == maps_of(tmp_path / "one").keys()
        for name in maps_of(out):
            # another number of threads may add in another order
            np.testing.assert_allclose(np.load(out / name), np.load(tmp_path / "one" / name), atol=1e-5)
        frame = pl.read_parquet(out / "confidence.parquet")
        assert_frame_equal(frame, alone.frame, abs_tol=1e-3)
    again = confidence_folder.score_disparity_manifest(
        listed, tmp_path / "three", ending=".npy", stride=4, shard=(1, 2)
    )
    assert (again.num_pairs, again.num_found, len(again.frame)) == (2, 2, 3)


def test_of_several_results_the_one_that_is_there_counts(listed: Path, tmp_path: Path) -> None:
    """Maps of method A, then of method B, then of A again; files of one size."""
    out, settings = tmp_path / "out", {"ending": ".npy", "stride": 4}
    first = listed.read_text()
    other = first.replace("map2.pfm", "map1.pfm")
    a = confidence_folder.score_disparity_manifest(listed, out, **settings)
    result = np.load(out / "two" / "d.npy")
    for text, found in ((other, 2), (other, 3), (first, 2)):
        listed.write_text(text)
        again = confidence_folder.score_disparity_manifest(listed, out, **settings)
        assert again.num_found == found
    assert_frame_equal(again.frame, a.frame, abs_tol=1e-3)
    np.testing.assert_allclose(np.load(out / "two" / "d.npy"), result, atol=1e-5)


def test_calls_that_divide_the_work_in_two_ways_exclude_each_other(listed: Path, tmp_path: Path) -> None:
    out, seen = tmp_path / "out", []

    def meanwhile(shard: tuple[int, int]) -> str:
        try:
            confidence_folder.score_disparity_manifest(listed, out, stride=4, shard=shard)
        except ValueError as error:
            return str(error)
        return "done"

    def look(done: int, total: int, name: str) -> None:
        if not seen:
            seen.extend(meanwhile(shard) for shard in ((1, 1), (1, 3), (1, 2), (2, 2)))

    confidence_folder.score_disparity_manifest(listed, out, stride=4, shard=(1, 2), on_progress=look)
    assert ["another call works on" in text for text in seen] == [True, True, True, False]
    assert seen[3] == "done"
    assert len(pl.read_parquet(out / "confidence.parquet")) == 3  # of both


def raise_key_error(job: object, task: object) -> ConfidenceSummary:
    raise KeyError("a fault of the library")


def score_with_a_fault(
    job: confidence_folder._Job, tasks: Sequence[confidence_folder._Task]
) -> ConfidenceSummary | confidence_folder._Failure:
    confidence_folder._score = raise_key_error
    return SCORE_IN_WORKER(job, tasks)


def test_a_fault_of_the_library_is_raised_from_a_worker(
    listed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confidence_folder, "_score_in_worker", score_with_a_fault)
    with pytest.raises(RuntimeError, match=r"a worker raised\n(?s:.*)KeyError: 'a fault of the library'"):
        confidence_folder.score_disparity_manifest(listed, tmp_path / "out", stride=4, num_workers=2)


def die_at_c(
    job: confidence_folder._Job, tasks: Sequence[confidence_folder._Task]
) -> ConfidenceSummary | confidence_folder._Failure:
    """A worker that is killed at one map."""
    if tasks[0].pair.scene == "deep/c":
        os.kill(os.getpid(), signal.SIGKILL)
    return SCORE_IN_WORKER(job, tasks)


def test_a_worker_that_is_killed_costs_one_map(listed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confidence_folder, "_score_in_worker", die_at_c)
    first = confidence_folder.score_disparity_manifest(listed, tmp_path / "out", stride=4, num_workers=2)
    assert list(first.errors) == ["two/deep/c"]
    assert "was killed" in first.errors["two/deep/c"]
    assert first.frame["scene"].to_list() == ["a b", "d"]
    monkeypatch.undo()
    rest = confidence_folder.score_disparity_manifest(listed, tmp_path / "out", stride=4, num_workers=2)
    assert (rest.num_found, rest.errors) == (2, {})


def test_what_is_kept_can_be_read_for_a_training(listed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    confidence_folder.score_disparity_manifest(listed, out, stride=2, shard=(1, 2))
    data = ConfidenceDataset(listed, out)
    assert len(data) == 2  # the second pair is of the other shard
    loader = DataLoader(data, batch_size=None, num_workers=1, multiprocessing_context="spawn")
    items = list(loader)
    assert [(item.pair.dataset, item.pair.name) for item in items] == [("one", "a b"), ("two", "d")]
    for item, (name, scale) in zip(items, (("map0.png", 256.0), ("map2.pfm", None)), strict=True):
        np.testing.assert_array_equal(item.disparity.numpy(), read_map(tmp_path / name, scale=scale))
        (expected,) = score_disparity(
            item.disparity, item.pair.image0[None], item.pair.image1[None], stride=2
        ).probability[0]
        assert item.stride == 2
        assert item.probability.shape == expected.shape
        assert (item.probability - expected.nan_to_num(0)).abs().max() <= 0.5 / 65535 + 1e-5  # 16 bits; threads
    with pytest.raises(IndexError, match="there are 2 maps, got number 2"):
        data[2]
    assert torch.equal(data[np.int64(1)].probability, items[1].probability)
    (tmp_path / "map0.png").write_bytes((tmp_path / "map1.png").read_bytes())
    with pytest.raises(ValueError, match="one/a b: its result is gone or of other files"):
        data[0]
    (out / "two" / "d.png").unlink()
    with pytest.raises(ValueError, match="two/d: its result is gone"):
        data[1]
    (out / "confidence.json").write_text("{}")
    with pytest.raises(ValueError, match="damaged: 'stride'"):
        ConfidenceDataset(listed, out)
    with pytest.raises(FileNotFoundError, match="holds no results"):
        ConfidenceDataset(listed, tmp_path)
