"""Carry one template mesh over to an animal of another shape: skeleton first, then the surface, then self-contacts.

``Template`` holds the mesh, its joints and one weight per vertex and segment; ``register`` bends it along the joints of
the animal and draws it onto the animal's surface, point by point, as rigidly in every part as can be (Amberg et al.,
"Optimal step nonrigid ICP", CVPR 2007, with the energy of Sorkine and Alexa, "As-rigid-as-possible surface modeling",
SGP 2007); ``smooth_crossings`` takes out what crosses itself afterwards. Left and right halves are kept symmetric.
"""

from dataclasses import dataclass

import igl
import numpy as np
import pymeshlab
import scipy.sparse as sp
import trimesh
from animal_skeleton import FLIP, NAMES, SEGMENTS
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

SAMPLES = 40_000  # points that measure how thick the animal is around its bones
# Steps at each stiffness: the first bring the parts to their places, the last but one fits, the last evens out.
STAGES = ((8, 4.0), (8, 1.0), (8, 0.4), (10, 0.15), (6, 0.4))


def mirror_map(verts: np.ndarray) -> np.ndarray:
    """For every vertex the one nearest to its mirror image."""
    return cKDTree(verts).query(verts * FLIP)[1]


def symmetric(verts: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mean of a shape and its mirror image; vertices without a counterpart stay."""
    paired = mirror[mirror] == np.arange(len(mirror))
    return np.where(paired[:, None], 0.5 * (verts + verts[mirror] * FLIP), verts)


def subdivide(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One step of Loop's subdivision."""
    verts, faces = trimesh.remesh.subdivide_loop(verts, faces, iterations=1)
    return np.ascontiguousarray(verts), np.ascontiguousarray(faces, dtype=np.int64)


def normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of the vertices."""
    return trimesh.Trimesh(verts, faces, process=False).vertex_normals


def voronoi_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The area around each vertex."""
    return np.asarray(igl.massmatrix(verts, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal())


def segment_distances(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Distance of each point to each segment (P, S); no point is near a limb of the other side."""
    out = np.empty((len(points), len(SEGMENTS)))
    for k, (start, end) in enumerate(SEGMENTS):
        along = joints[end] - joints[start]
        share = np.clip((points - joints[start]) @ along / (along @ along + 1e-12), 0, 1)
        out[:, k] = np.linalg.norm(points - (joints[start] + share[:, None] * along), axis=1)
        side = {"L": 1, "R": -1}.get(NAMES[end][-1] if "." in NAMES[end] else "", 0)
        out[points[:, 0] * side < -1e-3, k] = 1e3
    return out


def heat_weights(verts: np.ndarray, faces: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Weights (V, S) in heat equilibrium: (L + H) w = H p, where p marks the nearest segment and H is area / d^2.

    Reference: Baran and Popovic, "Automatic rigging and animation of 3D characters", SIGGRAPH 2007.
    """
    distances = segment_distances(verts, joints)
    heat = sp.diags(voronoi_areas(verts, faces) / np.maximum(distances.min(1), 1e-3) ** 2)
    nearest = np.eye(len(SEGMENTS))[distances.argmin(1)]
    weights = splu((heat - igl.cotmatrix(verts, faces)).tocsc()).solve(heat @ nearest)
    weights = np.clip(weights, 0, None)
    return weights / weights.sum(1, keepdims=True)


def girths(verts: np.ndarray, faces: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Median distance (S,) of the surface from each segment; NaN where hardly anything lies nearest to it."""
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(verts, faces, process=False), SAMPLES, seed=0)
    distances = segment_distances(points, joints)
    nearest = distances.argmin(1)
    parts = [distances[nearest == k, k] for k in range(len(SEGMENTS))]
    return np.array([np.median(part) if len(part) > 8 else np.nan for part in parts])


@dataclass
class Template:
    """Mesh, joints (J, 3), weights (V, S), girths (S,), mirror map (V,) and trust in the surface (V,), 0 to 1."""

    verts: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    girths: np.ndarray
    mirror: np.ndarray
    trust: np.ndarray


def make_template(verts: np.ndarray, faces: np.ndarray, joints: np.ndarray) -> Template:
    """Rig a symmetric mesh. Tails follow the bones more than the surface: in some animals they are a few flat faces."""
    weights = heat_weights(verts, faces, joints)
    tail = weights[:, [NAMES[end].startswith("tail") for _, end in SEGMENTS]].sum(1)
    trust = 1 - 0.9 * np.clip(1.5 * tail, 0, 1)
    return Template(verts, faces, joints, weights, girths(verts, faces, joints), mirror_map(verts), trust)


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that brings direction a to direction b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3)
    x, y, z = axis / sine
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + sine * cross + (1 - a @ b) * cross @ cross


def bend(template: Template, joints: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Blend of one map per segment: stretched to the new length, widened to the new girth, turned, put in place."""
    vectors = [np.array([j[end] - j[start] for start, end in SEGMENTS]) for j in (template.joints, joints)]
    old, new = (np.linalg.norm(v, axis=1) for v in vectors)
    size = np.median(new / old)
    wider = around / template.girths
    wider = np.clip(np.where(np.isfinite(wider), wider, size), 0.5 * size, 2 * size)
    longer = np.clip(new / old, 0.4 * size, 2.5 * size)
    out = np.zeros_like(template.verts)
    for k, (start, end) in enumerate(SEGMENTS):
        unit = vectors[0][k] / old[k]
        stretch = wider[k] * np.eye(3) + (longer[k] - wider[k]) * np.outer(unit, unit)
        matrix = turn_between(vectors[0][k], vectors[1][k]) @ stretch
        before, after = (0.5 * (j[start] + j[end]) for j in (template.joints, joints))
        out += template.weights[:, k, None] * ((template.verts - before) @ matrix.T + after)
    return out


class RigidEnergy:
    """As-rigid-as-possible energy of a mesh, with cotangent weights of the shape given as rest."""

    def __init__(self, rest: np.ndarray, faces: np.ndarray) -> None:
        laplacian = igl.cotmatrix(rest, faces).tocoo()
        edge = laplacian.row != laplacian.col
        self.start, self.end = laplacian.row[edge], laplacian.col[edge]
        weights = laplacian.data[edge]
        self.weights = np.clip(weights, 1e-3 * np.median(np.abs(weights)), None)
        both = np.r_[self.weights, -self.weights]
        places = (np.r_[self.start, self.start], np.r_[self.start, self.end])
        self.matrix = sp.csr_matrix((both, places), (len(rest), len(rest)))
        self.edges = rest[self.start] - rest[self.end]

    def step(self, verts: np.ndarray, stiffness: float, pull: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Best rotation of each vertex at ``verts``, then the vertices that minimise energy and pull to the goals."""
        edges = verts[self.start] - verts[self.end]
        covariance = np.zeros((len(verts), 3, 3))
        np.add.at(covariance, self.start, self.weights[:, None, None] * self.edges[:, :, None] * edges[:, None, :])
        left, _, right = np.linalg.svd(covariance)
        right[np.linalg.det(left @ right) < 0, -1] *= -1
        turns = (left @ right).swapaxes(1, 2)
        middle = 0.5 * (turns[self.start] + turns[self.end])
        rigid = np.zeros_like(verts)
        np.add.at(rigid, self.start, self.weights[:, None] * np.einsum("nij,nj->ni", middle, self.edges))
        system = (stiffness * self.matrix + sp.diags(pull)).tocsc()
        return splu(system).solve(stiffness * rigid + pull[:, None] * goals)


def register(
    template: Template, verts: np.ndarray, faces: np.ndarray, joints: np.ndarray, *, back: float = 0.35
) -> tuple[np.ndarray, float]:
    """The template's vertices on an animal, and their root mean square distance from it as a share of its height.

    Vertices are drawn to the closest points of the animal's surface and, with weight ``back``, to the mean of the
    animal's vertices that are closest to them: so that ears and muzzles are reached.
    """
    height = float(np.ptp(verts[:, 1]))
    shape = symmetric(bend(template, joints, girths(verts, faces, joints)), template.mirror)
    try:
        verts, faces = subdivide(verts, faces)
    except ValueError:  # more than two faces at an edge: take the surface as it is
        verts, faces = np.ascontiguousarray(verts), np.ascontiguousarray(faces, dtype=np.int64)
    goal = trimesh.Trimesh(verts, faces, process=False)
    face_normals, vertex_normals = goal.face_normals, goal.vertex_normals
    energy = RigidEnergy(shape, template.faces)
    area = voronoi_areas(shape, template.faces)
    trust = template.trust
    for steps, stiffness in STAGES:
        for _ in range(steps):
            facing = normals(shape, template.faces)
            squared, nearest, closest = igl.point_mesh_squared_distance(shape, verts, faces)[:3]
            found = ((facing * face_normals[nearest]).sum(1) > 0.4) & (np.sqrt(squared) < 0.1 * height)
            forth = found * area / area.mean() * trust
            # Closest in place and direction together.
            distance, taker = cKDTree(np.c_[shape, 0.08 * height * facing]).query(
                np.c_[verts, 0.08 * height * vertex_normals]
            )
            fits = (distance < 0.14 * height) & ((facing[taker] * vertex_normals).sum(1) > 0.3)
            count = np.bincount(taker[fits], minlength=len(shape))
            total = np.zeros_like(shape)
            np.add.at(total, taker[fits], verts[fits])
            pulled = (count > 0) * back * trust
            goals = forth[:, None] * closest + (pulled / np.maximum(count, 1))[:, None] * total
            pull = forth + pulled
            goals = np.where((pull > 0)[:, None], goals / np.maximum(pull, 1e-9)[:, None], shape)
            shape = symmetric(energy.step(shape, stiffness, pull + 1e-6, goals), template.mirror)
        energy = RigidEnergy(shape, template.faces)
    squared = igl.point_mesh_squared_distance(shape, verts, faces)[0]
    return shape, float(np.sqrt(squared.mean()) / height)


def crossing_faces(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Marks (F,) of the faces that cross others."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(verts, faces))
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().face_selection_array()


def smooth_crossings(verts: np.ndarray, faces: np.ndarray, *, rounds: int = 12) -> np.ndarray:
    """Smooth around faces that cross others, in ever wider patches, until none does or the rounds are over."""
    ends = faces[:, [0, 1, 2, 1, 2, 0]].ravel(), faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    neighbours = sp.csr_matrix((np.ones(len(ends[0])), ends), (len(verts), len(verts)))
    neighbours.data[:] = 1
    mean = sp.diags(1 / np.asarray(neighbours.sum(1)).ravel()) @ neighbours
    for turn in range(rounds):
        crossing = crossing_faces(verts, faces)
        if not crossing.any():
            break
        patch = np.zeros(len(verts), bool)
        patch[faces[crossing]] = True
        for _ in range(2 if turn > 3 else 1):
            patch |= neighbours @ patch.astype(float) > 0
        for _ in range(4):
            verts = np.where(patch[:, None], 0.5 * (verts + mean @ verts), verts)
    return verts
