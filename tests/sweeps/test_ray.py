"""The Ray engine on real clusters of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tensor_stereo.sweeps import SweepProgress, read_results, run_sweep
from tests.sweeps.conftest import Inputs, assert_same, stored

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
            if title.startswith(b"ray::run_tasks"):
                found.append(int(entry.name))
    return found


def test_two_nodes_give_the_rows_of_one_process(
    cluster: Any, inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
) -> None:
    summary = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", engine="ray")
    assert summary.progress.num_new == 12
    assert_same(stored(tmp_path / "run"), expected)


def test_a_killed_worker_and_a_removed_node_lose_no_unit(
    cluster: Any, inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
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


def test_the_command_joins_a_cluster_that_ray_start_made(
    inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
) -> None:
    """As the README says: a head, a second node on the loopback device, the address on the command line."""
    pytest.importorskip("ray")
    ray = str(Path(sys.executable).with_name("ray"))
    environment = os.environ | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "disabled"}
    quiet = {"check": True, "capture_output": True, "text": True, "env": environment}
    port = "6391"
    head = [
        "--head",
        "--node-ip-address",
        "127.0.0.1",
        "--port",
        port,
        "--num-cpus",
        "1",
        "--include-dashboard",
        "false",
    ]
    grid = (
        '[grid]\ndetector = ["fast", "gftt"]\nrestriction = ["adjacency", "cardinality"]\noutlier_rate = [0.0, 0.4]\n'
    )
    (tmp_path / "sweep.toml").write_text(grid)
    try:
        subprocess.run([ray, "start", *head], **quiet)  # type: ignore[call-overload]
        subprocess.run([ray, "start", "--address", f"127.0.0.1:{port}", "--num-cpus", "1"], **quiet)  # type: ignore[call-overload]
        command = [sys.executable, "-m", "tensor_stereo", "sweep", str(tmp_path / "sweep.toml"), "--engine", "ray"]
        command += ["--manifest", str(inputs.manifest), "--out", str(tmp_path / "run")]
        command += ["--ray-address", f"127.0.0.1:{port}"]
        result = subprocess.run(command, **quiet)  # type: ignore[call-overload]
        assert "12 of 12 units done" in result.stdout
    finally:
        subprocess.run([ray, "stop", "--force"], capture_output=True, check=False)
    assert_same(stored(tmp_path / "run"), expected)
