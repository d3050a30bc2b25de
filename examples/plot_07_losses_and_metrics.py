"""
Losses and metrics: conventions, and what each of them sees
==============================================================

"The Chamfer distance" is a family: squared or not, added or halved, summed or averaged. First each convention on a case
whose answer fits in the head, then seven ways to be wrong and the numbers that notice, then batches of unequal meshes.
"""

import matplotlib.pyplot as plt
import torch

from meshkit.batching import center, pad
from meshkit.data import load_humans
from meshkit.losses import (
    chamfer_loss,
    edge_length_loss,
    edge_ratio_loss,
    laplacian_loss,
    normal_consistency_loss,
    reconstruction_loss,
)
from meshkit.metrics import chamfer_distance, earth_movers_distance, edge_ratio, pmd
from meshkit.viz import render

torch.set_num_threads(1)


def expect(name, value, answer):
    """Print a value beside the answer by hand; a convention that changes stops the tutorial."""
    value = float(value)
    print(f"{name:46s} {value:8.4f}   by hand {answer:8.4f}")
    assert abs(value - answer) < 1e-5


# %%
# Points
# ------
# Two points at x = ±1, and a prediction that moved the right one by 3 along z. One of six coordinates is off, by 3.

target = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]]])
pred = torch.tensor([[[-1.0, 0, 0], [1, 0, 3]]])
expect("reconstruction_loss: mean over coordinates", reconstruction_loss(pred, target), 9 / 6)
expect("the same, reduction='sum'", reconstruction_loss(pred, target, reduction="sum"), 9)

# %%
# PMD centres the prediction, and only the prediction, by its bounding box: here by 1.5 along z, so that both points are
# off by 1.5. It is blind to where a body stands.

expect("pmd: prediction centred", pmd(pred, target), 2 * 1.5**2 / 6)
expect("pmd, recenter=False", pmd(pred, target, recenter=False), 9 / 6)
expect("pmd of a moved copy", pmd(target + 5, target), 0)

# %%
# Chamfer looks for the nearest point of the other set, in both directions, and adds the two means. A point at 0 against
# points at 2 and 4: forth 2, back 2 and 4. Papers report all four of these.

p, q = torch.zeros(1, 1, 3), torch.tensor([[[2.0, 0, 0], [4, 0, 0]]])
expect("chamfer_distance: squared, both added", chamfer_distance(p, q), 2**2 + (2**2 + 4**2) / 2)
expect("squared=False", chamfer_distance(p, q, squared=False), 2 + (2 + 4) / 2)
expect("direction='forward'", chamfer_distance(p, q, direction="forward"), 2**2)
expect("point_reduction='sum'", chamfer_distance(p, q, point_reduction="sum"), 2**2 + 2**2 + 4**2)
expect("chamfer_loss is the first of them", chamfer_loss(p, q), 14)

# %%
# The earth mover's distance uses every point once. Two points at 0 and one at 3, against one at 0 and two at 3:
# Chamfer finds every point's twin and says 0, although one of the three must travel 3.

a = torch.tensor([[[0.0, 0, 0], [0, 0, 0], [3, 0, 0]]])
b = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [3, 0, 0]]])
expect("chamfer_distance", chamfer_distance(a, b), 0)
expect("earth_movers_distance: length, mean over points", earth_movers_distance(a, b), 3 / 3)

# %%
# Edges, faces
# ------------
# A right triangle with legs 1, stretched twofold: every edge ratio is 2. The loss adds the three edges of each face and
# averages over faces; the metric counts every edge of the mesh once.

verts, faces = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), torch.tensor([[0, 1, 2]])
expect("edge_ratio_loss: sum over a face's edges", edge_ratio_loss(2 * verts, verts, faces), 3)
expect("edge_ratio: mean over edges", edge_ratio(2 * verts, verts, faces), 1)
expect("edge_length_loss: mean squared length", edge_length_loss(verts, faces), (1 + 1 + 2) / 3)

# %%
# Two faces folded at a right angle: one inner edge, and normals whose cosine is 0. In a flat square the cosine is 1.

square = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
folded = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
expect("normal_consistency_loss: folded", normal_consistency_loss(folded, torch.tensor([[0, 1, 2], [0, 3, 1]])), 1)
expect("normal_consistency_loss: flat", normal_consistency_loss(square, torch.tensor([[0, 1, 2], [0, 2, 3]])), 0)
expect("laplacian_loss: change from itself", laplacian_loss(verts, faces, reference=verts), 0)

# %%
# What they see
# -------------
# One body, and seven predictions that are wrong in seven ways.

rig = load_humans(1000)
truth = center(rig(torch.tensor([3]), torch.tensor([100])))
dice = torch.Generator().manual_seed(0)
ball = torch.nn.functional.normalize(torch.randn(1, 1000, 3, generator=dice), dim=2) * 0.5
predictions = {
    "truth": truth,
    "moved by 1 m": truth + 1,
    "5 % larger": 1.05 * truth,
    "noise, 1 cm": truth + 0.01 * torch.randn(truth.shape, generator=dice),
    "other order": truth[:, torch.randperm(1000, generator=dice)],
    "other body": center(rig(torch.tensor([50]), torch.tensor([100]))),
    "other pose": center(rig(torch.tensor([3]), torch.tensor([500]))),
    "a ball": ball,
}
rows = {
    "PMD": lambda x: 1e3 * pmd(x, truth),
    "Chamfer": lambda x: 1e3 * chamfer_distance(x, truth),
    "EMD": lambda x: 1e2 * earth_movers_distance(x, truth),
    "edge ratio": lambda x: 1e2 * edge_ratio(x, truth, rig.faces),
}
scores = {name: {row: float(score(x)) for row, score in rows.items()} for name, x in predictions.items()}

units = {"PMD": "1e-3 m²", "Chamfer": "1e-3 m²", "EMD": "cm", "edge ratio": "%"}
figure, axes = plt.subplots(2, len(predictions), figsize=(13, 3.8), height_ratios=(2, 1))
for (picture, table), (name, x) in zip(axes.T, predictions.items(), strict=True):
    picture.imshow(render(center(x)[0], rig.faces, size=(200, 270), scale=1.25, supersample=3))
    picture.set_title(name, fontsize=11)
    for k, row in enumerate(rows):
        value = scores[name][row]
        table.text(0.5, 0.9 - 0.25 * k, f"{value:.1f}", ha="center", transform=table.transAxes,
                   color="#a33" if value > 0.05 else "#686e76")  # fmt: skip
    picture.axis("off")
    table.axis("off")
for k, row in enumerate(rows):
    axes[1, 0].text(-0.1, 0.9 - 0.25 * k, f"{row} ({units[row]})", ha="right", transform=axes[1, 0].transAxes)
figure.subplots_adjust(left=0.15, right=0.995, top=0.92, bottom=0.0, wspace=0.02, hspace=0.02)

# %%
# Read by columns. *Moved*: PMD and the edge ratio do not see it, Chamfer and the earth mover's distance do, unless both
# sets are centred first. *Noise*: places hardly change, edges do. *Other order*: the shape is the same, so the sets
# agree, and PMD, which believes in the order, is larger than for another pose. *Other pose*: every number but the edge
# ratio is large, since a skinned body nearly keeps its lengths; *other body* is the opposite. None of the four does it
# all, so a report shows several.

assert scores["other order"]["Chamfer"] < 1e-3 and scores["other order"]["PMD"] > 10
assert scores["moved by 1 m"]["PMD"] < 1e-3 and scores["moved by 1 m"]["Chamfer"] > 1000
assert scores["noise, 1 cm"]["PMD"] < 1 < scores["noise, 1 cm"]["edge ratio"]

# %%
# Mirrored
# --------
# A body that exchanged its arms and legs is the error that unsupervised matching makes. In a symmetric pose the mirror
# image covers the body: Chamfer is small. PMD knows which vertex was which.

rest = center(rig.shape(torch.tensor([3]))[0])
mirrored = rest * torch.tensor([-1.0, 1, 1])
print(
    f"mirrored: Chamfer {1e3 * chamfer_distance(mirrored, rest).item():.2f}, PMD {1e3 * pmd(mirrored, rest).item():.1f}"
)
figure, axes = plt.subplots(1, 2, figsize=(5.2, 4))
side = (rest[0, :, :1] > 0).float()
colors = side * torch.tensor([0.85, 0.35, 0.2]) + (1 - side) * torch.tensor([0.45, 0.6, 0.8])
for axis, (name, x, f) in zip(
    axes, (("truth", rest, rig.faces), ("mirrored", mirrored, rig.faces.flip(1))), strict=True
):
    axis.imshow(render(x[0], f, size=(250, 350), colors=colors, azimuth=0, supersample=3))
    axis.set_title(name)
    axis.axis("off")
figure.tight_layout()
assert chamfer_distance(mirrored, rest) < 0.01 * pmd(mirrored, rest)

# %%
# Batches of unequal meshes
# -------------------------
# ``pad`` fills with zeros and says by a mask which vertices are real. A mesh scores in a batch what it scores alone;
# without the mask, the zeros would count as points.

other = load_humans(2000)(torch.tensor([3]), torch.tensor([500]))
preds, pred_mask = pad([truth[0], other[0]])
targets, target_mask = pad([other[0], truth[0]])
batch = chamfer_distance(preds, targets, pred_mask=pred_mask, target_mask=target_mask)
alone = torch.cat([chamfer_distance(truth, other), chamfer_distance(other, truth)])
print("padded, masked", batch.tolist(), "alone", alone.tolist(), "no mask", chamfer_distance(preds, targets).tolist())
torch.testing.assert_close(batch, alone)

# %%
# A loss averages within each mesh first, then over meshes: a mesh weighs the same whatever its size. NaN in the padding
# passes neither into the value nor into the gradient.

preds[~pred_mask] = float("nan")
preds.requires_grad_()
loss = chamfer_loss(preds, targets, pred_mask=pred_mask, target_mask=target_mask)
loss.backward()
expect("chamfer_loss of the batch", loss.detach(), float(alone.mean()))
assert (preds.grad[~pred_mask] == 0).all() and preds.grad[pred_mask].isfinite().all()
plt.show()
