"""What the README and the pages in docs/ show is what happens: examples, commands, links, names."""

from __future__ import annotations

import doctest
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from PIL import Image

from tensor_stereo import DelaunayFilter, cli, run_pipeline
from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets import render_pair, write_pfm
from tensor_stereo.datasets.images import write_image
from tensor_stereo.types import StereoPair

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
SHELL_BLOCK = re.compile(r"(?:^    \S.*\n)+", re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")

pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="README and docs are not installed with the tests")


def read_commands(page: Path) -> list[str]:
    """The lines of the shell blocks of a page, without comments."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in SHELL_BLOCK.findall(text) for line in block.splitlines()]
    commands = (re.sub(r"\s{2,}#.*", "", line.strip()) for line in lines)
    return [command for command in commands if re.match(r"(tensor-stereo|make|pip|python\d?|\.venv/bin/pip) ", command)]


def write_pair(pair: StereoPair, left: Path, right: Path) -> None:
    write_image(left, pair.image0)
    write_image(right, pair.image1)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a reader, with the files of the pair in the picture and a disparity map."""
    pair = render_pair((2016, 4))
    write_pair(pair, tmp_path / "left.png", tmp_path / "right.png")
    write_pfm(tmp_path / "map.pfm", pair.disparity_gt.numpy())
    (tmp_path / "maps.csv").write_text("image0,image1,disparity_est\nleft.png,right.png,map.pfm\n")
    monkeypatch.chdir(tmp_path)
    torch.set_printoptions(profile="default")
    return tmp_path


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 180


def test_examples_print_what_they_show(folder: Path) -> None:
    failed, tried = doctest.testfile(str(README), module_relative=False)
    assert tried > 20
    assert failed == 0
    assert (folder / "matches.png").stat().st_size > 10_000


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent == DOCS], ids=lambda page: page.name)
def test_examples_of_the_pages_print_what_they_show(page: Path, folder: Path) -> None:
    assert doctest.testfile(str(page), module_relative=False).failed == 0


@pytest.mark.parametrize("seed", range(5))
def test_the_first_example_is_good_whatever_the_points(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    left = torch.rand(1000, 2, generator=generator) * torch.tensor([640.0, 480.0])
    right = left - torch.tensor([25.0, 0.0])
    right[:300] = right[:300].flip(0)
    for points in (torch.float32, torch.float64):
        inlier = DelaunayFilter()(left.to(points), right.to(points)).inlier
        assert int(inlier[:300].sum()) <= 5
        assert int(inlier[300:].sum()) >= 690


def test_commands_of_the_readme_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_matches(folder / "matches.npz")
    small = render_pair((2016, 4), SyntheticConfig(width_px=160, height_px=120, max_disparity_px=24.0))
    scene = folder / "data/mine/room"
    scene.mkdir(parents=True)
    write_pair(small, scene / "im0.png", scene / "im1.png")
    write_pfm(scene / "disp0.pfm", small.disparity_gt.numpy())
    commands = [line for line in read_commands(README) if line.startswith("tensor-stereo ")]
    assert len(commands) >= 4
    for command in commands:
        cli.main(shlex.split(command)[1:])
        assert capsys.readouterr().out, f"{command} prints nothing"
        for name in written(command):
            assert Path(name).exists(), f"{command} does not write {name}"


def write_matches(path: Path) -> None:
    pair = render_pair((2016, 4))
    matches = run_pipeline([(pair.image0, pair.image1)]).matches
    np.savez(path, keypoints0=matches.keypoints0.numpy(), keypoints1=matches.keypoints1.numpy())


def written(command: str) -> list[str]:
    """The files and folders that a command is asked to write."""
    return re.findall(r"--(?:out|figure) (\S+)", command)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_known(page: Path) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for command in read_commands(page):
        program, *arguments = shlex.split(command)
        if program == "make":
            assert arguments[0] in targets, command
        elif program == "tensor-stereo":
            arguments = [value.replace("$SLURM_ARRAY_TASK_", "") for value in arguments]
            tyro.cli(cli.Command, args=arguments, config=(tyro.conf.OmitSubcommandPrefixes,))
        elif program == "pip":
            check_pip(arguments)
        elif program.startswith("python") and arguments[0] == "-c":
            exec(arguments[1], {})
        elif program.startswith("python") and arguments[0] != "-m":
            assert (ROOT / arguments[0]).is_file(), command


def check_pip(arguments: list[str]) -> None:
    """Raise unless the files and extras that an installation names are there."""
    assert arguments[0] == "install"
    if "-c" in arguments:
        assert (ROOT / arguments[arguments.index("-c") + 1]).is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_the_text_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    extras = set(re.findall(r"^([a-z]+) = \[", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {"hloc", "ray"} <= extras
    for extra in re.findall(r"`\[([a-z]+)\]`|tensor-stereo\[([a-z]+)\]", text):
        assert "".join(extra) in extras
    for code in CODE.findall(text):
        if re.fullmatch(r"tensor_stereo(\.\w+)+", code):
            resolve(code)
        elif re.fullmatch(r"(tensor_stereo|kernels|benchmarks|tests|notebooks|docs)/[\w./-]*", code):
            assert (ROOT / code).exists(), f"{page.name}: there is no {code}"


def resolve(name: str) -> object:
    """What a dotted name stands for; a module, or something in one."""
    parts = name.split(".")
    value: object = importlib.import_module(parts[0])
    for k, part in enumerate(parts[1:], 2):
        try:
            value = getattr(value, part)
        except AttributeError:
            value = importlib.import_module(".".join(parts[:k]))
    return value


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_point_to_files(page: Path) -> None:
    links = [link for link in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in link]
    for link in links:
        target = page.parent / link.partition("#")[0]
        assert target.exists(), f"{page.name}: there is no {link}"


def test_every_page_is_in_the_index() -> None:
    linked = set(LINK.findall((DOCS / "index.md").read_text(encoding="utf-8")))
    assert {page.name for page in DOCS.glob("*.md")} - {"index.md"} <= linked


def test_the_map_of_the_folders_is_true() -> None:
    """Each entry of the map exists, and no module or folder of the package is left out."""
    text = (DOCS / "map.md").read_text(encoding="utf-8")
    listed, parents = set(), {2: Path()}  # by the indentation of their lines
    for line in (line for line in text.splitlines() if line.startswith("    ")):
        depth = len(line) - len(line.lstrip())
        if depth > 8:  # the rest of a description
            continue
        parent = parents[depth - 2]
        for name in line.strip().partition("  ")[0].split():
            assert (ROOT / parent / name).exists(), f"there is no {parent / name}"
            listed.add(parent / name)
            parents[depth] = parent / name
    package = ROOT / "tensor_stereo"
    modules = {path.relative_to(ROOT) for path in package.glob("[a-z]*.py")}
    folders = {path.parent.relative_to(ROOT) for path in package.glob("*/__init__.py")}
    assert modules | folders <= listed


def test_the_picture_is_what_its_script_draws(tmp_path: Path) -> None:
    subprocess.run([sys.executable, DOCS / "make_picture.py", tmp_path / "verdicts.png"], check=True)
    with Image.open(tmp_path / "verdicts.png") as drawn, Image.open(DOCS / "verdicts.png") as shown:
        assert shown.mode == "P"
        assert drawn.size == shown.size
        difference = np.asarray(drawn.convert("L"), np.int16) - np.asarray(shown.convert("L"), np.int16)
    assert np.mean(np.abs(difference) > 32) < 0.01  # fonts and rounding may differ a little
    assert (DOCS / "verdicts.png").stat().st_size < 150_000
