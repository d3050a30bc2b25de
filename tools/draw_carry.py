"""Draw a mesh simplified, posed and carried back, a body that turns, and a page to turn two in, for docs/io_viz.md.

python tools/draw_carry.py docs/images
"""

import sys
from pathlib import Path

import torch

from meshkit.data import RiggedModel, load_humans
from meshkit.io import SurfaceBinding, mesh_report, simplify
from meshkit.viz import contact_sheet, position_colors, render, save_animation, save_html, turntable

folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)

# The network is the skeleton here, which poses the 1000 vertices; it also tells the truth for all 6890.
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

size, bounds = (220, 340), torch.stack([true.min(0).values, true.max(0).values])
pictures = [
    render(full.template, full.faces, size=size, supersample=3),
    render(posed, small.faces, shading="flat", size=size, bounds=bounds, supersample=3),
    render(carried, full.faces, size=size, bounds=bounds, supersample=3),
    render(true, full.faces, size=size, bounds=bounds, supersample=3),
]
titles = ["mesh", "simple, posed", "carried back", "truth"]
captions = ["6890 vertices", "1000 vertices", f"{1000 * distance.mean():.1f} mm mean error", "6890 vertices"]
sheet = contact_sheet([pictures], column_titles=titles, captions=[captions])
sheet.save(folder / "simplify_carry.png", optimize=True)

body = load_humans(2000)
identity, pose = body(torch.tensor([3, 50]), torch.tensor([10, 500]))
colors = position_colors(pose)
frames = turntable(pose, body.faces, colors=colors, frames=24, size=(180, 240))
save_animation(folder / "turntable.gif", frames)
save_html(
    folder / "correspondence.html",
    {"identity": (identity, body.faces), "pose": (pose, body.faces)},
    colors={"identity": colors, "pose": colors},
    title="Colour transfer",
)
