"""Everything on the CPU under another default device; modules are in test_conformance.py."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import rand
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor, nn

from meshkit.data import (
    MeshEntry,
    MeshPairs,
    MeshPool,
    MeshStore,
    PairSampler,
    PosePairs,
    human_split,
    load_humans,
    load_shipped,
    load_smpl,
    sample_bone_factors,
    sample_identities,
    sample_poses,
    turn_axes,
)
from meshkit.deform import deformation_transfer, key_point_correspondence, poisson_deform, rigid_moving_least_squares
from meshkit.descriptors import heat_kernel_signature, intrinsic_descriptors, wave_kernel_signature
from meshkit.io import clean_mesh, save_mesh
from meshkit.losses import edge_length_loss, matching_loss
from meshkit.metrics import MeanMetric
from meshkit.models import GeneratorConfig, PretrainedTransfer, load_generator, load_pretrained, mirror_labels
from meshkit.neighbors import knn
from meshkit.ot import log_optimal_transport, sinkhorn, sinkhorn_divergence, sinkhorn_from_cost
from meshkit.topology import connected_components, cotangent_laplacian, vertex_adjacency
from meshkit.transfer import save_page, save_picture, transfer_pose, transfer_sequence
from meshkit.transfer._frames import rotations, turn_up, turns_about
from meshkit.transfer._kinds import guess_kind, rest_body
from meshkit.transfer._openings import find_openings
from meshkit.transfer.report import TransferResult
from meshkit.viz import (
    error_colors,
    error_heat_map,
    position_colors,
    render,
    save_animation,
    transfer_colors,
    turntable,
)

X, Y, VALUES = rand(2, 40, 8), rand(2, 30, 8, seed=1), rand(2, 30, 3, seed=2)
MANY = rand(1, 1600, 8, dtype=torch.float32)  # whose stored kernel has a borrowed buffer
MASK = torch.arange(40).expand(2, -1) < torch.tensor([[40], [35]])
WEIGHTS = torch.full((2, 40), 1 / 40).double()
COLUMNS = torch.arange(40).expand(2, -1) % 30
HUMANS = load_humans(1000)
VERTS, FACES = HUMANS.template, HUMANS.faces
FLIP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
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
    check(FUNCTIONS[name])


def check(function: Callable[[], Any]) -> None:
    """Results under another default device, on which any tensor would be without data, are those under the CPU."""
    rest_body.cache_clear()
    with torch.device("meta"):  # first, so that nothing is kept from before
        results = list(parts(function()))
    for result, expected in zip(results, parts(function()), strict=True):
        assert torch.equal(result, expected) if isinstance(expected, Tensor) else result == expected


def parts(value: Any) -> Iterator[Any]:
    """What is to be compared in a result."""
    if is_dataclass(value) and not isinstance(value, Tensor):
        value = [getattr(value, field.name) for field in fields(value)]
    if isinstance(value, nn.Module):
        value = [*value.state_dict().values(), *value.buffers()]  # persistent or not
    if isinstance(value, list | tuple):
        for part in value:
            yield from parts(part)
    else:
        yield value if not isinstance(value, np.ndarray | Image.Image) else torch.tensor(np.array(value), device="cpu")


# Data


def folder_of_meshes(folder: Path, **options: Any) -> MeshPairs:
    """Two bodies in two poses as files, and pairs of them."""
    entries = []
    for who, body in enumerate((load_humans(1000), load_humans(2000))):
        posed = body(body.parents.new_tensor([who, who]), body.parents.new_tensor([0, 1]))
        for how, verts in enumerate(posed):
            entries.append(MeshEntry(folder / f"{who}_{how}.ply", who, how))
            save_mesh(entries[-1].path, verts, body.faces)
    store = MeshStore.build(entries, folder / "cache", progress=False, shard_bytes=1)
    return MeshPairs(store, length=8, pose_noise=0.1, **options)


def pose_pairs(**options: Any) -> Any:
    body, split = load_shipped("humans")
    return PosePairs(body, split.train_identities, split.train_poses, length=8, **options)[[(0, 1), (1, 2)]]


def pool() -> MeshPool:
    split = human_split()
    return MeshPool.build(HUMANS, split.train_identities, split.train_poses, 2, num_signatures=4, num_eigenpairs=8)


def listed(**options: Any) -> Any:
    held = human_split().test_pairs[:3]
    return pose_pairs(listed=held, **options)


DATA: dict[str, Callable[[], Any]] = {
    "humans": lambda: load_shipped("humans"),
    "animals": lambda: load_shipped("animals"),
    "posed": lambda: load_humans()(human_split().test_identities[:2], human_split().test_poses[:2]),
    "turned": lambda: turn_axes(load_humans(), FLIP),
    "pairs": lambda: pose_pairs(pose_noise=0.1),
    "listed": listed,
    "pool": lambda: (pool(), pose_pairs(pool=pool())),
    "sampler": lambda: [list(PairSampler(9, 2, stop=6, shuffle=shuffle)) for shuffle in (True, False)],
    "identities": lambda: sample_identities(HUMANS.identities, 3, generator=torch.Generator().manual_seed(0)),
    "poses": lambda: sample_poses(HUMANS.poses, HUMANS.parents, 3, generator=torch.Generator().manual_seed(0)),
    "bones": lambda: sample_bone_factors(
        HUMANS.joints, HUMANS.parents, 3, spread=0.1, generator=torch.Generator().manual_seed(0)
    ),
}


@pytest.mark.parametrize("name", DATA)
def test_data_are_on_the_cpu_whatever_the_default_device(name: str) -> None:
    check(DATA[name])


@pytest.mark.parametrize("options", [{}, {"shuffle": False}, {"window": 2}, {"ground_truth": False}], ids=str)
@pytest.mark.filterwarnings("ignore:no pose is shared")
def test_files_are_read_on_the_cpu_whatever_the_default_device(options: dict[str, Any], tmp_path: Path) -> None:
    check(lambda: folder_of_meshes(tmp_path, **options)[[(0, i) for i in range(4)]])


def test_models_are_read_on_the_cpu_whatever_the_default_device(tmp_path: Path) -> None:
    verts, joints, shapes = 6, 3, 2
    rng = np.random.default_rng(0)
    np.savez(
        tmp_path / "model.npz",
        v_template=rng.normal(size=(verts, 3)),
        kintree_table=np.array([[2**32 - 1, 0, 1], [0, 1, 2]]),
        f=np.array([[0, 1, 2], [3, 4, 5]]),
        shapedirs=rng.normal(size=(verts, 3, shapes)),
        posedirs=rng.normal(size=(verts, 3, 9 * (joints - 1))),
        weights=np.full((verts, joints), 1 / joints),
        J_regressor=np.full((joints, verts), 1 / verts),
    )
    check(lambda: load_smpl(tmp_path / "model.npz", z_up=True))


# Meshes and transfers


def net(**card: Any) -> PretrainedTransfer:
    """Untrained weights, with the same numbers every time."""
    with torch.device("cpu"), torch.random.fork_rng():
        torch.manual_seed(0)
        config = GeneratorConfig(extractor_widths=(8, 16), k=4, widths=(32, 16))
        return PretrainedTransfer(config.build(), config, card={"name": "untrained", **card}).eval()


def transferred(result: TransferResult) -> list[Any]:
    return [result.verts, result.faces, *result.report.doubts]


POSED = HUMANS(torch.tensor([0, 3]), torch.tensor([5, 11]))
BODY, OTHER = (VERTS, FACES), (POSED[1] @ rotations("+y", "+z")[0], FACES)
AXES = {"identity_up": "+z", "identity_facing": "-y", "refine": False, "weights": "auto"}
MESHES: dict[str, Callable[[], Any]] = {
    "carry": lambda: carried(VERTS, FACES[:-300]),
    "axes": lambda: (rotations(), turns_about(FLIP), turn_up(FLIP[0], FLIP[1]), turn_up(FLIP[0], -FLIP[0])),
    "kind": lambda: guess_kind(VERTS, FACES),
    "openings": lambda: [find_openings(VERTS, faces) for faces in (FACES, FACES[100:])],
    "weights": lambda: load_pretrained("xdualnet-humans"),
    "refined": lambda: transferred(
        transfer_pose(BODY, BODY, **AXES | {"weights": net(), "refine": True}, pose_up="+z", pose_facing="-y")
    ),
    "found": lambda: transferred(
        transfer_pose(BODY, OTHER, **AXES | {"weights": net(data="humans"), "frame": "identity"})
    ),
    "sequence": lambda: [
        transferred(result)
        for result in transfer_sequence(BODY, [OTHER, OTHER], **AXES | {"weights": net(data="humans")})
    ],
    "mean": lambda: MeanMetric(lambda x: x.mean(1)).compute().isnan(),
    "means": lambda: summed(VERTS, 2 * VERTS),
}


def carried(verts: Tensor, faces: Tensor) -> Tensor:
    clean = clean_mesh(verts, faces)
    return clean.carry(2 * clean.verts)


def summed(*batches: Tensor) -> Tensor:
    metric = MeanMetric(lambda x: x.mean(1))
    for batch in batches:
        metric.update(batch)
    return metric.compute()


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.filterwarnings("ignore")
def test_meshes_stay_where_they_are(name: str) -> None:
    check(MESHES[name])


def test_a_run_is_read_on_the_cpu_whatever_the_default_device(tmp_path: Path) -> None:
    trained = net()
    save_file(trained.generator.state_dict(), tmp_path / "model.safetensors")
    (tmp_path / "model.json").write_text(json.dumps(asdict(trained.config)))
    check(lambda: load_generator(tmp_path))


# Pictures


def picture(path: Path) -> list[Any]:
    pose = transfer_pose(BODY, BODY, **AXES | {"weights": net()}, pose_up="+z", pose_facing="-y")
    save_picture(path / "picture.png", [pose], size=40)
    save_page(path / "page.html", pose)
    return [np.array(Image.open(path / "picture.png")), (path / "page.html").read_text()]


def animated(path: Path) -> Any:
    save_animation(path / "turn.gif", turntable(VERTS, FACES, frames=3, size=(40, 40)))
    return (path / "turn.gif").read_bytes()


PICTURES: dict[str, Callable[[Path], Any]] = {
    "render": lambda path: render(VERTS, FACES, size=(40, 40), colors=error_colors(VERTS[:, 0].abs(), vmax=1.0)),
    "heat": lambda path: error_heat_map(VERTS, FACES, VERTS[:, 0].abs(), size=(40, 40)),
    "colors": lambda path: (position_colors(VERTS), transfer_colors(position_colors(VERTS), KEYS[:, 0])),
    "turntable": animated,
    "transfer": picture,
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_do_not_depend_on_the_default_device(name: str, tmp_path: Path) -> None:
    check(lambda: PICTURES[name](tmp_path))
