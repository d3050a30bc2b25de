"""Functions on the CPU under another default device; modules are in test_conformance.py."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from conftest import rand
from torch import Tensor

from meshkit.data import load_humans
from meshkit.deform import deformation_transfer, key_point_correspondence, poisson_deform, rigid_moving_least_squares
from meshkit.descriptors import heat_kernel_signature, intrinsic_descriptors, wave_kernel_signature
from meshkit.losses import edge_length_loss, matching_loss
from meshkit.models import mirror_labels
from meshkit.neighbors import knn
from meshkit.ot import log_optimal_transport, sinkhorn, sinkhorn_divergence, sinkhorn_from_cost
from meshkit.topology import connected_components, cotangent_laplacian, vertex_adjacency

X, Y, VALUES = rand(2, 40, 8), rand(2, 30, 8, seed=1), rand(2, 30, 3, seed=2)
MANY = rand(1, 1600, 8, dtype=torch.float32)  # whose stored kernel has a borrowed buffer
MASK = torch.arange(40).expand(2, -1) < torch.tensor([[40], [35]])
WEIGHTS = torch.full((2, 40), 1 / 40).double()
COLUMNS = torch.arange(40).expand(2, -1) % 30
HUMANS = load_humans(1000)
VERTS, FACES = HUMANS.template, HUMANS.faces
KEYS = torch.tensor([[0, 0], [250, 250], [500, 500], [750, 750]])


def plan(**options: Any) -> Any:
    return sinkhorn(X, Y, eps=0.3, **options)


def edge_gradient() -> Tensor:
    verts = VERTS[None].clone().requires_grad_()
    return torch.autograd.grad(edge_length_loss(verts, FACES.clone()), verts)[0]


FUNCTIONS: dict[str, Callable[[], Any]] = {
    "barycentric": lambda: plan(mask_x=MASK).barycentric(VALUES),
    "weights": lambda: plan(a=WEIGHTS).barycentric(VALUES),
    "topk": lambda: plan(mask_x=MASK).topk(3)[0],
    "mutual": lambda: plan(mask_x=MASK).mutual()[1],
    "assign": lambda: plan(mask_x=MASK).assign(),
    "log_at": lambda: plan(mask_x=MASK).log_at(COLUMNS),
    "repr": lambda: repr(plan()),
    "matching_loss": lambda: matching_loss(plan(), COLUMNS),
    "kept": lambda: sinkhorn(MANY, MANY, store="keep", domain="kernel").barycentric(MANY),
    "from_cost": lambda: sinkhorn_from_cost(torch.cdist(X, Y), eps=1.0).dense(),
    "divergence": lambda: sinkhorn_divergence(X, Y, eps=1.0, a=WEIGHTS),
    "dustbin": lambda: log_optimal_transport(X @ Y.mT, 1.0, n_iters=5, mask_x=MASK),
    "tree": lambda: knn(MANY, 4, method="tree", include_self=False),
    "tiles": lambda: knn(MANY, 4, method="tiles", include_self=False),
    "components": lambda: connected_components(FACES, len(VERTS)),
    "adjacency": lambda: vertex_adjacency(FACES, len(VERTS)).to_dense(),
    "laplacian": lambda: cotangent_laplacian(VERTS, FACES).to_dense(),
    "edges": edge_gradient,
    "heat": lambda: heat_kernel_signature(VERTS, FACES),
    "wave": lambda: wave_kernel_signature(VERTS, FACES),
    "descriptors": lambda: intrinsic_descriptors(VERTS, FACES, method="fast"),
    "mirror_labels": lambda: mirror_labels(VERTS, FACES, VERTS, VERTS.flip(0), torch.arange(len(VERTS), device="cpu")),
    "rigid": lambda: rigid_moving_least_squares(X[..., :3], 2 * X[..., :3], radius=1.0),
    "poisson": lambda: poisson_deform(X[..., :3], 2 * X[..., :3], radius=1.0),
    "transfer": lambda: deformation_transfer(VERTS, 2 * VERTS, VERTS, faces=FACES),
    "key_points": lambda: key_point_correspondence(
        VERTS, VERTS, KEYS, source_faces=FACES, target_faces=FACES
    ).to_dense(),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_stay_where_their_arguments_are(name: str) -> None:
    with torch.device(
        "meta"
    ):  # any tensor made there would be without data; first, so that nothing is kept from before
        result = FUNCTIONS[name]()
    expected = FUNCTIONS[name]()
    assert torch.equal(result, expected) if isinstance(expected, Tensor) else result == expected
