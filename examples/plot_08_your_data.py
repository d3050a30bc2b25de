"""
Your data: SMPL files, folders of meshes, broken meshes
==========================================================

Three ways in: a licensed body model, a folder of meshes, a mesh that nobody checked; and the command that trains on
each. The licensed files may not be passed on, so this tutorial writes a file of their layout and reads it. Nothing is
downloaded.
"""

import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from meshkit.batching import center
from meshkit.data import (
    Y_UP_TO_Z_UP,
    MeshPairs,
    MeshStore,
    PairSampler,
    load_humans,
    load_smpl,
    pair_loader,
    rotation_matrices,
    scan_pose_transfer,
)
from meshkit.io import SurfaceBinding, clean_mesh, load_mesh, mesh_report, save_mesh, simplify
from meshkit.viz import contact_sheet, render

torch.set_num_threads(1)
folder = Path(tempfile.mkdtemp(prefix="meshkit-"))


def show(picture):
    """Show a Pillow image as a figure, a pixel for a pixel."""
    figure = plt.figure(figsize=(picture.width / 100, picture.height / 100))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(picture)
    axes.axis("off")


# %%
# A body model of SMPL's layout
# -----------------------------
# A file of this layout holds a template, shape directions, pose correctives, skinning weights, a joint regressor and
# the tree of joints. It is y up. Here all are taken from the shipped rig, turned to y up, with no correctives; the
# regressor gives each joint the vertices around it.

rig = load_humans(1000)
to_z_up = torch.tensor(Y_UP_TO_Z_UP)
joints = rig.num_joints
near = torch.softmax(-(rig.joints[:, None] - rig.template).norm(dim=2) / 0.02, dim=1)
parents = rig.parents.numpy().astype(np.int64)
np.savez(
    folder / "body.npz",
    v_template=(rig.template @ to_z_up).numpy(),
    f=rig.faces.numpy().astype(np.uint32),
    shapedirs=(rig.shape_dirs[:10] @ to_z_up).permute(1, 2, 0).numpy(),
    posedirs=np.zeros((1000, 3, 9 * (joints - 1)), np.float32),
    J_regressor=near.numpy(),
    weights=rig.weights.numpy(),
    kintree_table=np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(joints)]).astype(np.uint32),
)

# %%
# ``load_smpl`` reads this, and the pickles of the published releases, which need neither Python 2 nor chumpy and cannot
# run code here. ``z_up=True`` turns the body to the frame of the recipes; poses made for y up are turned with it.

body = load_smpl(folder / "body.npz", z_up=True)
betas = torch.zeros(3, 10)
betas[1:, 0] = torch.tensor([1.5, -1.5])
vectors = torch.zeros(3, joints, 3)
vectors[2] = rig.poses[500]
bodies = body(betas, vectors)
print(type(body).__name__, tuple(body.template.shape), body.num_joints, "joints")
names = ["template", "shape 0 at +1.5", "shape 0 at -1.5, posed"]
show(contact_sheet([[render(v, body.faces, size=(220, 300), scale=1.5) for v in bodies]], column_titles=names))

# %%
# The template came back, turned twice: exactly.

assert torch.equal(bodies[0], body.template) or (bodies[0] - rig.template).abs().max() < 1e-6
print(f"largest difference from the rig: {(bodies[0] - rig.template).abs().max():.1e} m")

# %%
# A folder of meshes
# ------------------
# Name files ``{identity}_{pose}.obj`` (or .ply, .off, .stl, .glb). Within an identity the vertex order must be one, as
# its mesh in another pose is the ground truth; between identities everything may differ. Here are four people in four
# poses; two of them have a mesh of their own, simplified to 700 vertices; one file is damaged.

meshes = folder / "meshes"
for who, index in enumerate((3, 50, 120, 7)):
    posed = rig(torch.full((4,), index), torch.tensor([10, 100, 500, 700]))
    small = simplify(posed[0], rig.faces, 700) if who % 2 else None
    # The simplified mesh is bound to the full one and follows it through the poses.
    binding = SurfaceBinding(small.verts, small.faces, posed[0], rig.faces) if small else None
    for how, mesh in enumerate(posed):
        if small and binding:
            save_mesh(meshes / f"{who}_{how}.ply", binding.carry(mesh), small.faces)
        else:
            save_mesh(meshes / f"{who}_{how}.obj", mesh, rig.faces)
(meshes / "2_3.obj").write_text("v 0 0 0\nv 1 0\n")

# %%
# ``scan_pose_transfer`` reads the names, ``MeshStore`` parses the files once. With ``skip_bad=True`` a file that cannot
# be read is named and left out; the gap in the grid of people and poses is no error, since only pairs whose ground
# truth exists are drawn.

entries = scan_pose_transfer(meshes)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    store = MeshStore.build(entries, folder / "cache", skip_bad=True, progress=False)
print(len(entries), "files,", len(store), "meshes of", sorted(set(store.num_verts.tolist())), "vertices")
for path, reason in store.skipped:
    print("left out:", Path(path).name, "-", reason.replace(str(meshes), "."))

# %%
# Batches are padded, and a mask says which vertices are real; it is ``None`` where all are. Row by row: identity mesh,
# pose mesh, and the truth, in the vertex order of the first.

pairs = MeshPairs(store, length=64, seed=46)
batch = next(iter(pair_loader(pairs, PairSampler(len(pairs), 3, stop=1))))


def real(verts, mask, k):
    """Mesh k of a padded batch, without its padding."""
    return verts[k] if mask is None else verts[k][mask[k]]


rows = []
for k in range(3):
    own, theirs = (f[k][f[k][:, 0] >= 0] for f in (batch.identity_faces, batch.pose_faces))
    three = [
        (real(batch.identity, batch.identity_mask, k), own),
        (real(batch.pose, batch.pose_mask, k), theirs),
        (real(batch.ground_truth, batch.identity_mask, k), own),
    ]
    rows.append([render(center(v[None])[0], f, size=(210, 220), scale=2.0, shading="flat") for v, f in three])
print("identity meshes of", [len(real(batch.identity, batch.identity_mask, k)) for k in range(3)], "vertices")
show(contact_sheet(rows, column_titles=["identity", "pose", "ground truth"]))

# %%
# A mesh that nobody checked
# --------------------------
# Take a good body and do to it what files do: open the skull, tear it at the waist (both sides with vertices of their
# own, as at a seam of a texture), turn the upper half inside out, list a face twice, leave a scrap beside it.

verts, faces = load_mesh(meshes / "0_0.obj")
height = verts[faces].mean(1)[:, 2]
faces, height = (x[height < height.max() - 0.02] for x in (faces, height))
upper = height > height.mean()
scrap = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]) + torch.tensor([0.45, 0, 0.4])
scrap_faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
broken = torch.cat([verts, verts, scrap])
broken_faces = torch.cat(
    [faces[~upper], faces[upper].flip(1) + len(verts), faces[~upper][:1], scrap_faces + 2 * len(verts)]
)
before = mesh_report(broken, broken_faces)
print(before)

# %%
# ``clean_mesh`` says what it changed, and keeps the way back to the vertices of the file. Holes stay open: what is
# missing it does not invent.

clean = clean_mesh(broken, broken_faces)
print(clean)
after = mesh_report(clean.verts, clean.faces)
print(after)
assert len(before.components) == 4 and before.duplicate_faces == 1
assert after.manifold and len(after.components) == 1 and after.flipped_edges == after.duplicate_verts == 0

# %%
# Red are the ends of edges that belong to one face only. Surfaces seen from inside are dark.


def rim(verts, faces):
    """Red at the ends of open edges, grey elsewhere."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1)[0]
    edges, times = edges.unique(dim=0, return_counts=True)
    colors = torch.full((len(verts), 3), 0.75)
    colors[edges[times == 1].flatten()] = torch.tensor([0.9, 0.1, 0.1])
    return colors


box = torch.stack([broken.amin(0), broken.amax(0)])
pictures = [
    render(v, f, colors=rim(v, f), bounds=box, size=(300, 380), elevation=25, shading="flat", supersample=3)
    for v, f in ((broken, broken_faces), (clean.verts, clean.faces))
]
captions = [f"{len(v)} vertices, holes: {r.holes}" for v, r in ((broken, before), (clean.verts, after))]
show(contact_sheet([pictures], column_titles=["as it came", "clean"], captions=[captions]))

# %%
# What is done to the clean mesh goes back to the file: its 2004 vertices follow, welded ones together, dropped ones
# with the surface nearest to them. So a repaired mesh can be posed, and a texture made for the file still fits.

turn = rotation_matrices(torch.tensor([0.3, -0.4, 1.2]))
off = (clean.carry(clean.verts @ turn.T) - broken @ turn.T).abs().max()
print(f"turned through the clean mesh, the {len(broken)} vertices are within {off:.0e} m of where they belong")
assert off < 1e-5

# %%
# Train on it
# -----------
# The recipes read all of these, and compute the signatures of files once. Where vertex counts differ, X-DualNet must
# compare all vertices, ``--points None``. A damaged file stops a recipe with a line that names it. A folder needs two
# people and two poses to train on, and two others of each to test on. ::
#
#     python recipes/xdualnet.py --data smpl:body.npz
#     python recipes/xdualnet.py --data smal:smal_CVPR2017.pkl
#     python recipes/xdualnet.py --data folder:meshes --points None
#     python recipes/corenet3d.py --data folder:meshes
#     python recipes/npt.py --data folder:meshes
#
# ``meshkit-transfer identity.obj pose.obj -o posed.obj`` cleans its meshes by itself, and needs no training.

(meshes / "2_3.obj").unlink()
plt.show()
