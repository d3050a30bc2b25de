"""One recipe on several processes: the same losses and weights as on one, also after a process was lost."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from recipe_runs import RECIPES, ROOT, environment, launch, read_json, read_log
from safetensors.torch import load_file

pytest.importorskip("tyro")
pytest.importorskip("lightning_fabric")

STEPS = 4
# Nothing random in a step: all vertices, no handles. Two generator passes share the spectral norms' buffers.
SMALL = (
    f"--threads 1 --accelerator cpu --precision 32-true --pairs 36 --eval-pairs 1 --steps {STEPS} --save-every 1 "
    "--lr 1e-4 "
    "--points None --no-arap --model.descriptors none --model.condition features --model.no-match-size "
    "--model.rigid-radius None --model.widths 16 8 --model.extractor-widths 8 8 --model.k 4"
)


def losses(folder: Path) -> torch.Tensor:
    records = read_log(folder)
    assert [record["step"] for record in records] == list(range(1, STEPS + 1))
    return torch.tensor([[r[name] for name in ("rec_a", "rec_b", "corr", "edge", "loss")] for r in records])


def assert_same_run(folder: Path, single: Path) -> None:
    torch.testing.assert_close(losses(folder), losses(single), rtol=1e-4, atol=0)
    ours, theirs = (load_file(path / "model.safetensors") for path in (folder, single))
    assert ours.keys() == theirs.keys()
    for name in ours:
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-3, atol=1e-4, msg=name)
    assert read_json(folder / "summary.json")["pairs_seen"] == read_json(single / "summary.json")["pairs_seen"]


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on one process, with batches of 4."""
    out = tmp_path_factory.mktemp("single")
    run = launch("xdualnet", "--out", out, "--name", "single", "--batch", 4, *SMALL.split())
    assert run.returncode == 0, run.stderr
    return out / "single"


def workers(agent: int) -> list[int]:
    """The processes that torchrun has started."""
    return [int(pid) for pid in Path(f"/proc/{agent}/task/{agent}/children").read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes through /proc")
def test_two_processes_equal_one_although_one_of_them_is_killed(single: Path, tmp_path: Path) -> None:
    """Two batches of 2 are one of 4; torchrun starts both processes again, and they go on from the checkpoint."""
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = [str(RECIPES / "xdualnet.py"), "--resume", "--out", str(tmp_path), "--name", "two", "--batch", "2"]
    folder = tmp_path / "two"
    with subprocess.Popen(
        [*torchrun, "--max-restarts", "1", "--monitor-interval", "0.2", *script, *SMALL.split()],
        cwd=ROOT,
        # Without the variable, processes that start again may read each other's old addresses.
        env=environment() | {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as agent:
        try:
            deadline = time.monotonic() + 90
            while not (folder / "state.pt").exists():
                assert agent.poll() is None and time.monotonic() < deadline
                time.sleep(0.005)
            os.kill(workers(agent.pid)[1], signal.SIGKILL)
            errors = agent.communicate(timeout=120)[1]
        finally:
            for pid in workers(agent.pid) if agent.poll() is None else []:
                os.kill(pid, signal.SIGKILL)
            agent.kill()
    assert agent.returncode == 0, errors
    assert errors.count("All distributed processes registered. Starting with 2 processes") == 2
    assert_same_run(folder, single)
