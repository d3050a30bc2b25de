"""Draw what the shipped weights make of unseen test pairs, the README's picture.

python tools/draw_weights.py
"""

from pathlib import Path

import torch

from meshkit.batching import center
from meshkit.data import load_shipped
from meshkit.metrics import pmd
from meshkit.models import load_pretrained
from meshkit.viz import contact_sheet, error_colors, position_colors, render

IMAGES = Path(__file__).parents[1] / "docs" / "images"
WORST = 0.15  # of the error's colours
ROWS = (  # weights, body, rows of the list of test pairs
    ("corenet3d-humans", "humans", (1, 10)),
    ("xdualnet-humans", "humans", (9,)),
    ("corenet3d-animals", "animals", (3, 12)),
    ("xdualnet-animals", "animals", (12,)),
)


WARPED = (11, 22)  # rows whose warps differ
WAYS = {"matching's means": (None, None), "rigid MLS": (0.25, None), "Poisson": (0.15, 0.2)}  # radius, weight
HUMANS, ANIMALS = ("xdualnet-humans", "humans"), ("xdualnet-animals", "animals")
MATCHED = (  # file, weights, body, rows, symmetry by title, view
    # one lower leg is taken for the other
    ("exchanged_limbs", *HUMANS, (62, 48, 83), {"as matched": False, "symmetry": True}, {"size": (240, 240)}),
    # the fox's tail is taken for a leg
    ("tails", *ANIMALS, (195, 351), {"output": False}, {"size": (260, 220), "azimuth": 70}),
)


def load_pair(body, row):
    """Identity mesh, pose mesh and truth of a row of the test pairs."""
    who, how, other, wanted = row[:, None]
    return body(who, how), body(other, wanted), body(who, wanted)


def together(meshes):
    """The meshes, centred, and the box of all."""
    meshes = [center(verts)[0] for verts in meshes]
    everything = torch.cat(meshes)
    return meshes, torch.stack([everything.amin(0), everything.amax(0)])


def score(result, truth):
    return f"PMD {1e3 * float(pmd(result[None], truth[None])):.1f}e-3"


@torch.no_grad()
def draw_weights() -> None:
    pictures, captions = [], []
    for name, kind, rows in ROWS:
        net, (body, split) = load_pretrained(name), load_shipped(kind)
        for row in rows:
            identity, pose, truth = load_pair(body, split.test_pairs[row])
            output = net.output(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
            meshes, bounds = together([identity, pose, output.warped, output.vertices, truth])
            error = error_colors((meshes[3] - meshes[4]).norm(dim=1), vmax=WORST)
            views = [*((verts, None) for verts in meshes), (meshes[3], error)]
            pictures.append(
                [render(v, body.faces, colors=colors, bounds=bounds, size=(240, 240)) for v, colors in views]
            )
            captions.append([name, "", "", score(meshes[3], meshes[4]), "", ""])
    titles = ["identity", "pose", "warped", "output", "ground truth", "error"]
    bar = (0.0, 100 * WORST, "distance to ground truth (cm; animals: 0.01 units)")
    sheet = contact_sheet(pictures, column_titles=titles, captions=captions, colorbar=bar)
    sheet.quantize(128).save(IMAGES / "shipped_weights.png", optimize=True)


@torch.no_grad()
def draw_matched(name: str, weights: str, kind: str, rows, ways, view) -> None:
    """Which vertices were taken for each other, and what came of it, with and without symmetry."""
    net, (body, split) = load_pretrained(weights), load_shipped(kind)
    pictures, captions = [], []
    for row in rows:
        identity, pose, truth = load_pair(body, split.test_pairs[row])
        results = []
        for symmetry in ways.values():
            net.generator.symmetry = symmetry
            results.append(net.output(identity, pose, identity_faces=body.faces, pose_faces=body.faces))
        colors = position_colors(pose[0])
        meshes, bounds = together([identity, pose, *(r.vertices for r in results), truth])
        painted = [colors[results[0].plan.argmax()[0]], colors, *[None] * len(ways), None]
        views = zip(meshes, painted, strict=True)
        pictures.append([render(v, body.faces, colors=c, bounds=bounds, **view) for v, c in views])
        captions.append(["matched places", "", *(score(v, meshes[-1]) for v in meshes[2:-1]), ""])
    titles = ["identity", "pose", *ways, "ground truth"]
    sheet = contact_sheet(pictures, column_titles=titles, captions=captions)
    sheet.quantize(255).save(IMAGES / f"{name}.png", optimize=True)


@torch.no_grad()
def draw_warps() -> None:
    net, (body, split) = load_pretrained("xdualnet-humans"), load_shipped("humans")
    warped, pictures, captions = [], [], []
    net.generator.transfer.register_forward_pre_hook(lambda _, inputs: warped.append(inputs[0][0]))
    for row in WARPED:
        identity, pose, truth = load_pair(body, split.test_pairs[row])
        for net.generator.rigid_radius, net.generator.poisson_weight in WAYS.values():
            net(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
        meshes, bounds = together([identity, pose, *(w[None] for w in warped), truth])
        warped.clear()
        pictures.append([render(v, body.faces, bounds=bounds, size=(240, 240)) for v in meshes])
        captions.append(["", "", *(score(v, meshes[-1]) for v in meshes[2:-1]), ""])
    titles = ["identity", "pose", *WAYS, "ground truth"]
    contact_sheet(pictures, column_titles=titles, captions=captions).quantize(128).save(
        IMAGES / "warps.png", optimize=True
    )


if __name__ == "__main__":
    draw_weights()
    draw_warps()
    for picture in MATCHED:
        draw_matched(*picture)
