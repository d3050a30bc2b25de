"""
Matching two bodies, and the pictures of it
===========================================

Two people in different poses are matched by wave-kernel signatures, which hardly change when a body bends, together
with the place in the body, which tells left from right. The match is drawn in three ways: colours carried from one body
to the other, lines between matching points, and a map of the errors. Then a mesh is simplified, posed with few
vertices, and the pose is carried back to all of them.

Run it from a checkout; pictures are written to the folder given as the first argument, if any::

    python examples/plot_correspondence.py pictures
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from meshkit.batching import center
from meshkit.data import RiggedModel, load_humans
from meshkit.descriptors import wave_kernel_signature
from meshkit.io import SurfaceBinding, mesh_report, simplify
from meshkit.ot import sinkhorn
from meshkit.viz import (
    contact_sheet,
    correspondence_figure,
    error_heat_map,
    position_colors,
    render,
    save_animation,
    save_html,
    turntable,
)

folder = Path(sys.argv[1]) if len(sys.argv) > 1 and not sys.argv[1].startswith("-") else None


def show(picture, name):
    """Show a picture in the gallery, and write it if a folder was given."""
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        picture.save(folder / f"{name}.png", optimize=True)
    figure = plt.figure(figsize=(picture.width / 100, picture.height / 100))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(picture)
    axes.axis("off")


# %%
# Two identities in two poses, 2000 vertices each. Both bodies stand upright, so places compare once they are centred.

body = load_humans(2000)
identity, pose = body(torch.tensor([3, 50]), torch.tensor([10, 500]))
both = torch.stack([identity, pose])
signatures = wave_kernel_signature(both, body.faces, num_signatures=64)
signatures = (signatures - signatures.mean(1, keepdim=True)) / signatures.std(1, keepdim=True)
place = center(both) / identity[:, 2].std()
features = torch.cat([signatures, 8 * place], dim=2)

plan = sinkhorn(features[:1], features[1:], eps=0.03)
matches = plan.argmax()[0]
error = (pose[matches] - pose).norm(dim=1)  # the true match of vertex i is vertex i
print(f"mean error {100 * error.mean():.1f} cm, {100 * (error < 0.1).float().mean():.0f} % within 10 cm")

# %%
# Colours and lines. Every vertex on the left takes the colour of its match on the right; red lines are off by more
# than 10 cm.

show(
    correspondence_figure(
        (identity, body.faces), (pose, body.faces), matches, correct=error < 0.1, titles=["identity", "pose"]
    ),
    "correspondence",
)

# %%
# Where the errors are.

show(
    error_heat_map(
        identity, body.faces, 100 * error, label="error of the match (cm)", vmax=50, titles=["front", "side", "back"]
    ),
    "error_heat_map",
)

# %%
# A mesh from a file is measured first, then simplified for a network. Here the network is the skeleton, which poses the
# 1000 vertices; ``carry`` brings the pose back to all 6890.

full = load_humans(6890)
print(mesh_report(full.template, full.faces))
small = simplify(full.template, full.faces, 1000)
near = SurfaceBinding(small.verts, small.faces, full.template, full.faces)
weights = torch.einsum("vk,vkj->vj", near.weights.float(), full.weights[full.faces[near.face]])
coarse = RiggedModel(
    small.verts, small.faces, torch.zeros(1, 1000, 3), full.joints, torch.zeros(1, full.num_joints, 3), weights,
    full.parents, poses=full.poses,
)  # fmt: skip
true = full(torch.zeros(1, 40), torch.tensor([500]))[0]
posed = coarse(torch.zeros(1, 1), torch.tensor([500]))[0]
carried = small.carry(posed)
distance = (carried - true).norm(dim=1)
print(f"carried to 6890 vertices: mean error {1000 * distance.mean():.2f} mm")

options = {"size": (220, 340), "bounds": torch.stack([true.min(0).values, true.max(0).values]), "supersample": 3}
show(
    contact_sheet(
        [
            [
                render(full.template, full.faces, size=(220, 340), supersample=3),
                render(posed, small.faces, shading="flat", **options),
                render(carried, full.faces, **options),
                render(true, full.faces, **options),
            ]
        ],
        column_titles=["mesh", "simple, posed", "carried back", "truth"],
        captions=[["6890 vertices", "1000 vertices", f"{1000 * distance.mean():.1f} mm mean error", "6890 vertices"]],
    ),
    "simplify_carry",
)

# %%
# A turntable, and a page with both bodies to turn in a browser, without a network.

if folder:
    frames = turntable(pose, body.faces, colors=position_colors(pose), frames=24, size=(180, 240))
    save_animation(folder / "turntable.gif", frames)
    colors = position_colors(pose)
    save_html(
        folder / "correspondence.html",
        {"identity": (identity, body.faces), "pose": (pose, body.faces)},
        colors={"identity": colors[matches], "pose": colors},
        title="Colour transfer",
    )
