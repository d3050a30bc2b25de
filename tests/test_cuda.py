"""The same numbers on a GPU as on the CPU: whole training steps in float64, and in float32 in its accuracy."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import assert_near, rand
from torch import Tensor

from meshkit.consistency import DualReconstruction
from meshkit.data import load_humans
from meshkit.losses import backward_correspondence_loss, edge_ratio_loss, reconstruction_loss
from meshkit.models import PoseTransferGenerator
from meshkit.ot import sinkhorn

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def generator(dtype: torch.dtype) -> PoseTransferGenerator:
    torch.manual_seed(0)
    net = PoseTransferGenerator(
        extractor_widths=(8, 16),
        k=6,
        descriptors=5,
        widths=(32, 16),
        residual=True,
        condition="descriptors",
        rigid_radius=0.3,
        match_size=True,
    )
    torch.nn.init.normal_(net.transfer.narrow[-1].get_parameter("weight"), std=0.1)
    return net.to(dtype)


def step(device: str, dtype: torch.dtype, *, padded: bool = False) -> tuple[Tensor, list[Tensor]]:
    """Loss and gradients of a dual step."""
    body = load_humans(1000)
    a, b = (
        body(torch.tensor([0, 1, 2]), torch.tensor([3, 4, 5])),
        body(torch.tensor([6, 7, 8]), torch.tensor([9, 10, 11])),
    )
    inputs = {"identity": a, "pose": b}
    inputs |= {"identity_descriptors": 0.1 * rand(3, 1000, 5), "pose_descriptors": 0.1 * rand(3, 1000, 5, seed=1)}
    if padded:
        inputs |= {
            name: torch.arange(1000) < torch.tensor([[1000], [700], [999]]) for name in ("identity_mask", "pose_mask")
        }
    inputs = {k: v.to(device, dtype if v.is_floating_point() else v.dtype) for k, v in inputs.items()}
    net, faces = generator(dtype).to(device), body.faces.to(device)
    result = DualReconstruction(net)(**inputs)
    loss = reconstruction_loss(result.reconstruction_a, result.target_a, mask=inputs.get("identity_mask"))
    loss = loss + reconstruction_loss(result.reconstruction_b, result.target_b, mask=inputs.get("pose_mask"))
    loss = loss + backward_correspondence_loss(result.plan, result.target_b, pose_mask=inputs.get("pose_mask"))
    if not padded:
        loss = loss + edge_ratio_loss(result.output, inputs["identity"], faces)
        loss = loss + edge_ratio_loss(result.output, inputs["pose"], faces.expand(3, -1, -1))
    return loss.cpu(), [g.cpu() for g in torch.autograd.grad(loss, list(net.parameters()))]


@pytest.mark.parametrize("padded", [False, True])
def test_dual_step_in_float64(padded):
    (loss, gradients), (expected, truths) = (step(d, torch.float64, padded=padded) for d in ("cuda", "cpu"))
    assert_near(loss, expected, 1e-9)
    scale = max(truth.abs().amax().item() for truth in truths)
    for gradient, truth in zip(gradients, truths, strict=True):
        assert_near(gradient, truth, 1e-7, scale=scale)


@pytest.mark.parametrize("padded", [False, True])
def test_dual_step_in_float32(padded):
    loss, gradients = step("cuda", torch.float32, padded=padded)
    expected, truths = step("cpu", torch.float64, padded=padded)
    assert_near(loss.double(), expected, 2e-3)  # of vertices equally far to rounding, another may be a neighbour
    scale = max(truth.abs().amax().item() for truth in truths)
    for gradient, truth in zip(gradients, truths, strict=True):
        assert_near(gradient.double(), truth, 2e-2, scale=scale)


@pytest.mark.parametrize(
    "options", [{}, {"store": "stream"}, {"eps": 1e-3}, {"reach": 1.0}, {"cost": "sqeuclidean", "eps": 0.5}]
)
def test_sinkhorn_with_gradients(options):
    results = []
    for device, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        x, y = (t.to(device, dtype).requires_grad_() for t in (rand(2, 300, 16), rand(2, 200, 16, seed=1)))
        warped = sinkhorn(x, y, **options).barycentric(rand(2, 200, 3, seed=2).to(device, dtype))
        upstream = rand(2, 300, 3, seed=3).to(device, dtype)
        results.append([t.cpu().double() for t in (warped, *torch.autograd.grad(warped, (x, y), upstream))])
    for got, expected in zip(*results, strict=True):
        assert_near(got, expected, 5e-3)


def test_graphed_steps_equal_eager_ones(tmp_path):
    """Both recipes' loop with and without --graph, ARAP's eager steps in the end included."""
    pytest.importorskip("tyro")
    pytest.importorskip("lightning_fabric")
    script = Path(__file__).parents[1] / "recipes" / "xdualnet.py"
    logs = []
    for name, flags in (("eager", []), ("graphed", ["--graph"])):
        flags += ["--steps", "8", "--pool", "12", "--batch", "2", "--eval-pairs", "2", "--out", str(tmp_path)]
        flags += ["--precision", "32-true", "--name", name]
        subprocess.run([sys.executable, script, *flags], check=True, capture_output=True)
        lines = (tmp_path / name / "log.jsonl").read_text().splitlines()
        logs.append([json.loads(line)["loss"] for line in lines])
    assert logs[1] == pytest.approx(logs[0], rel=2e-2)
