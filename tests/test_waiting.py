"""Processes of the library's own wait without spinning; those of its users stay as they are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tensor_stereo.waiting import passive_children

TELL = "import os; print(os.environ.get('OMP_WAIT_POLICY'), 'torch' in __import__('sys').modules)"


def run(code: str, **environment: str) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    found = subprocess.run(
        [sys.executable, "-c", code], env=clean | environment, capture_output=True, text=True, check=True
    )
    return found.stdout.splitlines()[-1]


def test_the_command_line_sets_the_policy_before_torch_is_loaded() -> None:
    command = "from tensor_stereo.cli import main; main(['--version']); "
    assert run(command + TELL) == "PASSIVE False"
    assert run(command + TELL, OMP_WAIT_POLICY="ACTIVE") == "ACTIVE False"


def test_the_library_and_a_command_behind_torch_leave_it_alone() -> None:
    assert run("import tensor_stereo as ts; ts.DelaunayFilter(); " + TELL) == "None True"
    assert run("import torch; from tensor_stereo.cli import main; main(['--version']); " + TELL) == "None True"


def test_children_get_the_policy_and_their_parent_keeps_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    for own in (None, "ACTIVE"):
        monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
        if own is not None:
            monkeypatch.setenv("OMP_WAIT_POLICY", own)
        with passive_children():
            assert os.environ["OMP_WAIT_POLICY"] == (own or "PASSIVE")
        assert os.environ.get("OMP_WAIT_POLICY") == own


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="this system has no /proc")
def test_workers_of_a_sweep_wait_passively() -> None:
    code = (
        "import os\n"
        "from tensor_stereo.configs import SweepConfig\n"
        "from tensor_stereo.sweeps.engines import local_engine\n"
        "if __name__ == '__main__':\n"
        "    engine = local_engine(SweepConfig(), 1)\n"
        "    engine._start_worker()\n"
        "    (worker,) = engine._workers.values()\n"
        "    told = open(f'/proc/{worker.process.pid}/environ', 'rb').read().split(b'\\0')\n"
        "    engine.close()\n"
        "    print(b'OMP_WAIT_POLICY=PASSIVE' in told, os.environ.get('OMP_WAIT_POLICY'))\n"
    )
    assert run(code) == "True None"
