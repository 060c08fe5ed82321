"""The flag ``--rectified``, and what commands say that they took pairs for."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tensor_stereo.cli import _parse, main
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tests.cli.printed import printed_values


@pytest.mark.parametrize(("word", "value"), [("True", True), ("False", False), ("auto", "auto")])
def test_every_command_takes_rectified(word: str, value: object) -> None:
    for command in (["classify", "a.png", "b.png"], ["evaluate", "a"], ["filter", "a.csv", "--out", "b.csv"]):
        found = _parse([*command, "--rectified", word]).config.rectified
        assert found == value
        assert type(found) is type(value)
        assert _parse(command).config.rectified == ("auto" if command[0] == "filter" else True)


@pytest.mark.parametrize("command", ["classify", "evaluate", "filter"])
def test_the_help_names_the_values_of_rectified(command: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert "--rectified {True,False,auto}" in capsys.readouterr().out
    for value in ("1", "yes", "true"):
        with pytest.raises(SystemExit) as stop:
            main([command, "a.csv", "--rectified", value])
        assert stop.value.code == 2
        assert "--rectified" in capsys.readouterr().err


def test_classify_says_what_auto_took_the_pair_for(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pair = render_pair(0)
    height, width = pair.image0.shape[-2:]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 15, 1)
    cv2.imwrite(str(tmp_path / "left.png"), pair.image0[0].numpy())
    cv2.imwrite(str(tmp_path / "right.png"), pair.image1[0].numpy())
    cv2.imwrite(str(tmp_path / "turned.png"), cv2.warpAffine(pair.image0[0].numpy(), turn, (width, height)))
    left, right, turned = (str(tmp_path / f"{name}.png") for name in ("left", "right", "turned"))
    kept = []
    for other, expected in ((right, "yes"), (turned, "no")):
        main(["classify", left, other, "--detector", "sift", "--rectified", "auto"])
        printed = printed_values(capsys)
        assert printed["rectified"] == expected
        kept.append(int(printed["num_kept"]))
        known = "True" if expected == "yes" else "False"
        main(["classify", left, other, "--detector", "sift", "--rectified", known])
        printed = printed_values(capsys)
        assert "rectified" not in printed
        assert int(printed["num_kept"]) == kept[-1]
    assert min(kept) > 100
    main(["classify", left, right, "--verdict", "cardinality", "--rectified", "auto"])  # which asks for no rows
    assert "rectified" not in printed_values(capsys)


def test_filter_counts_the_pairs_that_it_takes_for_rectified(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    points = np.random.default_rng(0).random((3, 200, 2)) * [320, 240]
    others = points - [5.0, 0.0]
    others[1] = points[1] @ np.array([[0.8, -0.6], [0.6, 0.8]])
    matches = tmp_path / "m.npz"
    rows = {"keypoints0": points.reshape(-1, 2), "keypoints1": others.reshape(-1, 2)}
    np.savez(matches, **rows, ptr=np.arange(4) * 200)
    main(["filter", str(matches), "--out", str(tmp_path / "out.npz")])
    printed = printed_values(capsys)
    assert (printed["num_pairs"], printed["num_rectified"]) == ("3", "2")
    main(["filter", str(matches), "--out", str(tmp_path / "out.npz"), "--verdict", "cardinality"])
    assert "num_rectified" not in printed_values(capsys)
