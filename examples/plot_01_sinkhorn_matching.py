"""
A Sinkhorn layer in place of soft attention
===========================================

Soft attention lets every row choose its columns alone, so that many rows may choose one column and leave others without
any. A Sinkhorn layer scales rows *and* columns: every vertex of both bodies gets its share. Here the same small network
is trained twice, from the same start and on the same pairs, once with each of the two layers.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn
from torch.nn.functional import normalize

from meshkit.batching import center
from meshkit.data import load_humans
from meshkit.descriptors import wave_kernel_signature
from meshkit.neighbors import gather_vertices
from meshkit.ot import sinkhorn
from meshkit.viz import position_colors, render, transfer_colors

torch.set_num_threads(1)

# %%
# The two layers
# --------------
# Both take features ``fx (B, N, D)`` and ``fy (B, M, D)`` and carry values of the columns to the rows. They share the
# cosine similarity and the temperature. What differs is the normalisation: of rows alone, or five times of columns and
# rows.

EPS = 0.03


def attention(fx, fy):
    """Rows that sum to 1."""
    return torch.softmax(normalize(fx, dim=2) @ normalize(fy, dim=2).mT / EPS, dim=2)


def transport(fx, fy):
    """The same, with columns that sum to 1 as well, up to what five iterations leave."""
    plan = sinkhorn(fx, fy, eps=EPS, n_iters=5).dense()
    return plan / plan.sum(2, keepdim=True)


# %%
# The plan is made dense here to be compared. In a network of your own, ``sinkhorn(fx, fy).barycentric(values)`` returns
# the carried values at once and need not store the N x M matrix.
#
# Pairs of bodies
# ---------------
# Two people in two poses, 1000 vertices each. Inputs are the place of a vertex and 16 wave-kernel signatures, which
# bending hardly changes. Eight test pairs have identities and poses that training never sees.

body = load_humans(1000)
generator = torch.Generator().manual_seed(0)


def draw(count, identities, poses):
    """Posed bodies and their signatures."""
    who = torch.randint(*identities, (count,), generator=generator)
    how = torch.randint(*poses, (count,), generator=generator)
    verts = center(body(who, how))
    return verts, wave_kernel_signature(verts, body.faces, num_signatures=16)


verts, signatures = draw(32, (0, 160), (0, 850))
test_verts, test_signatures = draw(16, (160, 200), (850, 1000))
mean, deviation = signatures.mean((0, 1)), signatures.std((0, 1))
inputs = torch.cat([verts, (signatures - mean) / deviation], 2)
test_inputs = torch.cat([test_verts, (test_signatures - mean) / deviation], 2)

# %%
# Training
# --------
# The loss asks that the carried positions are those of the true matches: vertex i of one body is vertex i of the other.
# The network cannot know, as it works vertex by vertex.

steps = 150
layers = {"soft attention": attention, "Sinkhorn": transport}
curves, networks = {}, {}
for name, layer in layers.items():
    torch.manual_seed(0)
    network = nn.Sequential(
        nn.Linear(19, 64), nn.LeakyReLU(0.1), nn.Linear(64, 64), nn.LeakyReLU(0.1), nn.Linear(64, 32)
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    curves[name], networks[name] = [], network
    for _ in range(steps):
        first, second = torch.randperm(len(verts))[:8].chunk(2)
        some = torch.randperm(1000)[:300]
        fx, fy = network(inputs[first][:, some]), network(inputs[second][:, some])
        values = verts[second][:, some]
        loss = (layer(fx, fy) @ values - values).square().sum(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        curves[name].append(loss.item())

# %%
# What was learned
# ----------------
# The match of a row is its heaviest column. We count errors in metres on the second body, and how many of its vertices
# are matched by any row.

x, y = test_verts.chunk(2)
plans, matches = {}, {}
with torch.no_grad():
    for name, layer in layers.items():
        fx, fy = networks[name](test_inputs).chunk(2)
        plans[name] = layer(fx, fy)
        matches[name] = plans[name].argmax(2)
        error = (gather_vertices(y, matches[name]) - y).norm(dim=2)
        used = sum(len(match.unique()) for match in matches[name]) / error.numel()
        print(
            f"{name}: mean error {100 * error.mean():.1f} cm, {100 * (error < 0.1).float().mean():.0f} % within 10 cm, "
            f"{100 * used:.0f} % of the vertices are matched, largest column sum {plans[name].sum(1).max():.1f}"
        )

# %%
# Sinkhorn halves the error. The reason is in the sums of the columns: attention heaps the mass of many rows on few
# columns, and its gradient has no term that would spread it.

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.2), layout="constrained")
for (name, curve), color in zip(curves.items(), ("tab:orange", "tab:blue"), strict=True):
    smooth = torch.tensor(curve).unfold(0, min(10, steps), 1).mean(1)
    left.semilogy(smooth, color=color, label=name)
    right.plot(plans[name][0].sum(0).sort(descending=True).values, color=color, label=name)
left.set(xlabel="step", ylabel="training loss (m²)", title="mean of 10 steps")
right.axhline(1, color="0.6", linewidth=0.8)
right.set(xlabel="vertices of the second body, sorted", ylabel="mass received", title="column sums of a test pair")
left.legend(frameon=False)

# %%
# The plans themselves, rows and columns in the order of height: a right plan lies near the diagonal, and stripes are
# columns that many rows share.

order = body.template[:, 2].argsort()
figure, axes = plt.subplots(1, 2, figsize=(8.0, 4.2), layout="constrained")
for axis, (name, plan) in zip(axes, plans.items(), strict=True):
    blocks = plan[0][order][:, order].view(100, 10, 100, 10).sum((1, 3)) / 10
    axis.imshow(blocks.sqrt(), cmap="magma", vmax=0.8, origin="lower")
    axis.set(title=name, xlabel="second body, feet to head", ylabel="first body", xticks=[], yticks=[])

# %%
# Colours carried along the matches. A wrong colour is a wrong match.

colors = position_colors(y[0])
pictures = {"second body": render(y[0], body.faces, colors=colors)}
for name, match in matches.items():
    pictures[f"first body, {name}"] = render(x[0], body.faces, colors=transfer_colors(colors, match[0]))
figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.4), layout="constrained")
for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(name, fontsize=10)
    axis.axis("off")
plt.show()
