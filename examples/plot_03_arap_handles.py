"""
Six handles: ARAP, harmonic and biharmonic deformation
======================================================

Pull a body by six handles, look at what as-rigid-as-possible deformation does that interpolation of displacements does
not, and let the gradient of the solver find handle positions that nobody gave.
"""

import igl
import matplotlib.pyplot as plt
import numpy as np
import torch

from meshkit.data import load_humans
from meshkit.deform import arap_deform, arap_energy
from meshkit.viz import render

torch.set_num_threads(1)
rig = load_humans(2000)
rest, faces = rig.shape(torch.tensor([0]))[0][0].double(), rig.faces

# %%
# Handles
# -------
# A handle is a small patch of vertices that moves rigidly: head, hands, feet and pelvis. The left hand goes up and
# forward, the right foot makes a step, the head nods; the other three stay where they are.

low, high = rest.amin(0), rest.amax(0)
left, right = rest[:, 0] > 0, rest[:, 0] < 0
ends = {
    "head": rest[:, 2].argmax(),
    "left hand": rest[:, 0].argmax(),
    "right hand": rest[:, 0].argmin(),
    "left foot": torch.where(left, rest[:, 2], torch.inf).argmin(),
    "right foot": torch.where(right, rest[:, 2], torch.inf).argmin(),
    "pelvis": torch.where(rest[:, 0].abs() < 0.05, (rest[:, 2] - 0.05).abs() + rest[:, 1], torch.inf).argmin(),
}
patches = {name: (rest - rest[at]).norm(dim=1).topk(20, largest=False).indices for name, at in ends.items()}


def turned(points, center, axis, degrees):
    """Rotate points about an axis through a centre."""
    axis = torch.tensor(axis, dtype=torch.float64) * np.deg2rad(degrees)
    skew = torch.zeros(3, 3, dtype=torch.float64)
    skew[[2, 0, 1], [1, 2, 0]], skew[[1, 2, 0], [2, 0, 1]] = axis, -axis
    return (points - center) @ torch.matrix_exp(skew).T + center


def point(x, y, z):
    return torch.tensor([x, y, z], dtype=torch.float64)


goal = {name: rest[index] for name, index in patches.items()}
shoulder, hip, neck = point(0.17, 0.0, 0.5), point(-0.1, 0.0, -0.1), point(0.0, 0.0, 0.6)
goal["left hand"] = turned(goal["left hand"], shoulder, (0.0, -1.0, 0.0), 100)
goal["right foot"] = turned(goal["right foot"], hip, (-1.0, 0.0, 0.0), 55)
goal["head"] = turned(goal["head"], neck, (0.0, 1.0, 0.0), 20)
handles = torch.cat(list(patches.values()))
handle_pos = torch.cat(list(goal.values()))

# %%
# Three ways to fill in the rest
# ------------------------------
# Harmonic and biharmonic deformation interpolate the displacements of the handles, as smoothly as the membrane or the
# thin-plate energy asks. They are linear, and know nothing of rotations: limbs that should swing are sheared and thin
# out. ARAP finds a rotation for every neighbourhood, so that only the joints between them pay.

displacement = (handle_pos - rest[handles]).numpy()
arguments = rest.numpy(), faces.numpy(), handles.numpy()
shapes = {"rest and handles": rest}
for order, name in ((1, "harmonic"), (2, "biharmonic")):
    shapes[name] = rest + torch.from_numpy(igl.harmonic(*arguments, displacement, order))
shapes["as rigid as possible"], info = arap_deform(rest, faces, handles, handle_pos)
print(f"ARAP: energy {float(info.energy):.3f} after {int(info.evaluations)} evaluations")

edges = igl.edges(faces.numpy())


def stretch(x):
    """Relative change of every edge, its 95th percentile."""
    before, after = ((v[edges[:, 0]] - v[edges[:, 1]]).norm(dim=1) for v in (rest, x))
    return float((after / before - 1).abs().quantile(0.95))


colors = np.tile(np.array([0.72, 0.76, 0.82]), (len(rest), 1))
colors[handles] = 0.85, 0.35, 0.2
everything = torch.cat(list(shapes.values()))
bounds = torch.stack([everything.amin(0), everything.amax(0)])


def draw(shapes, name):
    figure, axes = plt.subplots(1, len(shapes), num=name, dpi=110, figsize=(2.6 * len(shapes), 4.6))
    for axis, (name, x) in zip(axes, shapes.items(), strict=True):
        axis.imshow(render(x, faces, size=(390, 620), colors=colors, azimuth=35, bounds=bounds, scale=1.4))
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("" if x is rest else f"95 % of edges change by < {100 * stretch(x):.0f} %", fontsize=9)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    figure.tight_layout()
    return figure


figure = draw(shapes, "arap_handles")

# %%
# Handles that are found
# ----------------------
# The deformation is differentiable in the handle positions. Suppose a left knee and a right elbow were seen somewhere
# that the six handles do not lead to. Which handle positions do? Each handle may shift as a whole, 18 numbers, and
# gradient descent runs through the solver; a little of the energy in the loss keeps limbs from being pulled long. Each
# solve starts from the last one.

knee = (rest - point(0.11, -0.02, -0.55)).norm(dim=1).argmin()
elbow = (rest - point(-0.36, 0.03, 0.27)).norm(dim=1).argmin()
seen = torch.stack([knee, elbow])
start = shapes["as rigid as possible"]
target = start[seen] + torch.stack([point(0.06, -0.15, 0.04), point(-0.02, -0.1, 0.12)])
owner = torch.cat([torch.full((len(index),), k) for k, index in enumerate(patches.values())])


def solve(shift, init, **options):
    return arap_deform(rest, faces, handles, handle_pos + shift[owner], init=init, **options)[0]


def missed(x):
    return (x[seen] - target).square().sum()


# %%
# First, is the gradient right? It is that of the minimum, by the implicit function theorem, without a record of the
# iterations. Central differences of the whole solver tell: the left foot, moved back and forth by 5 mm. Both ask for a
# minimum that is reached to the last digits.

shift = torch.zeros(6, 3, dtype=torch.float64, requires_grad=True)
tight = {"tol": 1e-13, "max_iter": 2000}
missed(solve(shift, start, grad_tol=1e-6, **tight)).backward()
nudge = torch.zeros(6, 3, dtype=torch.float64)
nudge[3, 1] = 5e-3
with torch.no_grad():
    plus, minus = (missed(solve(sign * nudge, start, **tight)) for sign in (1, -1))
print(f"gradient {float(shift.grad[3, 1]):.5f}, central difference {float(plus - minus) / 1e-2:.5f}")

# %%
# Then it is descended.

optimiser = torch.optim.Adam([shift], lr=0.02)
x, curve = start, []
steps = 30
for _ in range(steps):
    optimiser.zero_grad()
    x = solve(shift, x.detach())
    miss = missed(x)
    (miss + 0.03 * arap_energy(rest, faces, x)).backward()
    optimiser.step()
    curve.append(100 * miss.item() ** 0.5)
print(f"{curve[0]:.1f} cm off at the start, {curve[-1]:.1f} cm after {steps} steps")
for name, moved in zip(patches, shift.detach(), strict=True):
    print(f"{name:10s} moved by {float(moved.norm()):.2f} m")

figure, axis = plt.subplots(num="handles_curve", figsize=(5.5, 2.8), layout="constrained")
axis.plot(range(1, steps + 1), curve)
axis.set(xlabel="step", ylabel="distance to the targets (cm)", ylim=(0, None))

# %%
# Green is around the knee and the elbow. All six handles took part, also those that were to stay: give them a loss of
# their own if they must.

colors[torch.cdist(rest[seen], rest).topk(50, largest=False).indices.flatten()] = 0.1, 0.5, 0.25
draw({"before": start, "led to where they were seen": x.detach()}, "handles_found")
plt.show()
