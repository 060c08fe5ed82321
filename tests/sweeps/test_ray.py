"""The Ray engine on real clusters of this machine."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tensor_stereo.sweeps import SweepProgress, read_results, run_sweep
from tests.sweeps.conftest import GRID, Inputs, assert_same, stored

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]  # Ray's own, of sockets and future changes


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two nodes with one CPU each, connected."""
    pytest.importorskip("ray")
    import ray
    from ray.cluster_utils import Cluster

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    nodes.second = nodes.add_node(num_cpus=1)  # type: ignore[attr-defined]
    ray.init(address=nodes.address, log_to_driver=False, configure_logging=False)
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def _ray_workers() -> list[int]:
    """Processes of this user that run, or have run, a task of a sweep."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                title = (entry / "cmdline").read_bytes()
            except OSError:  # it has ended
                continue
            if title.startswith(b"ray::run_batch"):
                found.append(int(entry.name))
    return found


def test_two_nodes_give_the_rows_of_one_process(
    cluster: Any, inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
) -> None:
    summary = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", engine="ray")
    assert summary.progress.num_new == 12
    assert_same(stored(tmp_path / "run"), expected)


@pytest.mark.parametrize("once", range(3))  # what is under way when a node goes differs
def test_a_killed_worker_and_a_removed_node_lose_no_unit(
    cluster: Any, inputs: Inputs, expected: pl.DataFrame, tmp_path: Path, once: int
) -> None:
    faults = []

    def fault(_: SweepProgress) -> None:
        if not faults:
            faults.append(_ray_workers()[0])
            os.kill(faults[0], signal.SIGKILL)
        elif len(faults) == 1:
            faults.append(cluster.second)
            cluster.remove_node(cluster.second)

    summary = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", engine="ray", on_progress=fault)
    assert len(faults) == 2
    assert summary.progress.num_failed == 0
    assert_same(stored(tmp_path / "run"), expected)
    assert (read_results(tmp_path / "run")["attempt"] > 1).any()


def test_without_ray_it_fails_also_when_nothing_is_left_to_do(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=1, limit=0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"needs Ray: pip install 'tensor-stereo\[ray\]'"):
        run_sweep(inputs.config, inputs.manifest, tmp_path / "run", engine="ray", limit=0)


def _start(environment: dict[str, str], *options: str) -> subprocess.Popen[str]:
    """A Ray node in the foreground, running when this returns."""
    ray = Path(sys.executable).with_name("ray")
    command = [ray, "start", *options, "--num-cpus", "1", "--block", "--disable-usage-stats"]
    node = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)  # type: ignore[arg-type]
    printed = []
    assert node.stdout is not None
    for line in node.stdout:
        printed.append(line)
        if "Ray runtime started" in line:
            return node
    raise AssertionError("".join(printed))


def test_the_command_joins_a_cluster_that_ray_start_made(
    inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
) -> None:
    """As the README says: a head, a second node, the address on the command line."""
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "sweep.toml").write_text(GRID)
    environment = os.environ | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    nodes: list[subprocess.Popen[str]] = []
    try:
        nodes.append(_start(environment, "--head", "--node-ip-address", "127.0.0.1", "--port", str(port)))
        nodes.append(_start(environment, "--address", f"127.0.0.1:{port}"))
        command = [sys.executable, "-m", "tensor_stereo", "sweep", str(tmp_path / "sweep.toml"), "--engine", "ray"]
        command += ["--manifest", str(inputs.manifest), "--out", str(tmp_path / "run")]
        command += ["--ray-address", f"127.0.0.1:{port}"]
        result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        assert "12 of 12 units done" in result.stdout, result.stderr
    finally:
        for node in reversed(nodes):
            node.terminate()
            node.communicate(timeout=60)
    assert_same(stored(tmp_path / "run"), expected)
