"""
Scale: several processes, larger batches, going on
=====================================================

One recipe, one process or many. First what each process is given, then the same training by one process and by two,
with their losses over each other; then accumulation, resumption, CUDA graphs, and the commands for machines larger than
this one.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from safetensors.torch import load_file

import meshkit
from meshkit.data import PairSampler

root = Path(meshkit.__file__).parents[1]  # recipes lie beside the package in a clone, and are not installed with it
folder = Path(tempfile.mkdtemp(prefix="meshkit-"))

# %%
# Who gets which pairs
# --------------------
# An update of ``--batch 2`` on two processes sees four pairs. The sampler is addressed by the step: it needs to know
# the seed, the step, and which process of how many it serves. So the four are those of ``--batch 4`` on one process,
# and a run that goes on at step 2 sees what it would have seen.


def pairs_of(batch, **options):
    """Numbers of the pairs of the first three steps."""
    return [[pair for _, pair in step] for step in PairSampler(48, batch, seed=0, stop=3, **options)]


whole = pairs_of(4)
first, second = (pairs_of(2, rank=rank, world_size=2) for rank in range(2))
for s in range(3):
    print(f"step {s + 1}: one process {whole[s]}, two processes {first[s]} and {second[s]}")
    assert sorted(first[s] + second[s]) == sorted(whole[s])
assert pairs_of(4, start=2) == whole[2:]

# %%
# One process, two processes
# --------------------------
# Both train Neural Pose Transfer on the shipped humans, in a small size; its steps are deterministic. ``torchrun``
# starts two processes of the same script, which connect through gloo on CPUs and nccl on GPUs. The losses in the log
# are means over all pairs of an update, whoever computed them.

steps = 12
settings = (
    f"--threads 1 --accelerator cpu --precision 32-true --pairs 48 --eval-pairs 1 --steps {steps} --lr 3e-3 "
    "--adam-eps 1e-4 --warmup 1 --model.extractor-widths 16 32 61"
)
one = f"{sys.executable} recipes/npt.py --name one --batch 4"
two = f"{sys.executable} -m torch.distributed.run --standalone --nproc-per-node 2 recipes/npt.py --name two --batch 2"
paths = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
runs = {}
for name, command in {"one": one, "two": two}.items():
    runs[name] = subprocess.Popen(
        [*command.split(), "--out", str(folder), *settings.split()],
        cwd=root,
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
for name, run in runs.items():
    errors = run.communicate(timeout=300)[1]
    assert run.returncode == 0, f"{name}: {errors[-2000:]}"


def read(name):
    """Losses of a run's log, and its summary."""
    lines = (folder / name / "log.jsonl").read_text().splitlines()
    summary = json.loads((folder / name / "summary.json").read_text())
    return torch.tensor([json.loads(line)["loss"] for line in lines], dtype=torch.float64), summary


(losses_one, summary_one), (losses_two, summary_two) = read("one"), read("two")
difference = (losses_two / losses_one - 1).abs()
print(f"processes: {summary_one['processes']} and {summary_two['processes']}")
print(f"pairs seen: {summary_one['pairs_seen']} and {summary_two['pairs_seen']}")
print(f"largest relative difference of a loss: {difference.max():.1e}")
assert len(losses_one) == len(losses_two) == steps and summary_two["processes"] == 2
assert difference.max() < 1e-5

# %%
# Equal but for the order of summation, and so are the weights. Adam divides a gradient by its own size and so magnifies
# rounding where gradients are near zero; ``--adam-eps 1e-4`` damps that.

weights_one, weights_two = (load_file(folder / name / "model.safetensors") for name in ("one", "two"))
apart = max(float((weights_one[key] - weights_two[key]).abs().max()) for key in weights_one)
print(f"largest difference of a weight: {apart:.1e}")

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.6), sharex=True, height_ratios=(2, 1))
numbers = range(1, steps + 1)
above.plot(numbers, losses_one, color="#9db4d0", linewidth=5, label="one process, batch 4")
above.plot(numbers, losses_two, color="#a33", linestyle=":", marker=".", label="two processes, batch 2 each")
above.set_ylabel("loss")
above.set_ylim(bottom=0)
above.legend(frameon=False)
below.semilogy(numbers, difference.clamp_min(1e-9), color="#686e76", marker=".")
below.set_ylabel("relative difference")
below.set_xlabel("step")
figure.tight_layout()

# %%
# The processes of a GPU machine are started by the recipe itself or by torchrun; ``--batch`` is per process. ::
#
#     python recipes/xdualnet.py --devices 4                               # one process per GPU
#     python recipes/xdualnet.py --devices 2 --accelerator cpu             # shares of a processor
#     torchrun --nproc-per-node 4 recipes/xdualnet.py --batch 4            # the same as --devices 4
#
# Memory is short: accumulate
# ---------------------------
# ``--accumulate 4`` averages the gradients of four batches before each update. Here 4 x 1 x 4 = 16 pairs per update, as
# with ``--batch 4`` alone. X-DualNet and 3D-CoreNet have spectral normalisation, whose power iteration moves on with
# every pass, so for them the result differs slightly from that of one large batch. ::
#
#     torchrun --nproc-per-node 4 recipes/xdualnet.py --batch 1 --accumulate 4
#
# Going on, and beginning elsewhere
# ---------------------------------
# ``--resume`` goes on from the run's last checkpoint with the settings it was begun with. At one thread a killed run
# ends with the weights it would have had, bit for bit. The number of processes may change: batches are accumulated or
# split so that an update sees the same pairs. ``--init`` is another thing: a new run, with the weights of a shipped
# network or of a run's folder, and an optimiser that knows nothing. ::
#
#     python recipes/xdualnet.py --name mine --save-every 50
#     python recipes/xdualnet.py --name mine --resume
#     python recipes/xdualnet.py --name mine --resume --devices 2
#     python recipes/xdualnet.py --name other --data animals --init runs/mine
#
# Small networks on a large GPU
# -----------------------------
# A step of a small network is some ten thousand short kernels, which take longer to launch than to run. ``--graph``
# records a step as a CUDA graph and replays it: for one process, without ``--compile``, on meshes of one size; steps
# with ARAP run as usual. With the command below a step took 175 ms instead of 400 ms, beside four other runs on one
# H100. ::
#
#     python recipes/xdualnet.py --preset small --graph

plt.show()
