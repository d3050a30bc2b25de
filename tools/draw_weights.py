"""Draw what the shipped weights make of unseen test pairs, the README's picture.

python tools/draw_weights.py
"""

from pathlib import Path

import torch

from meshkit.batching import center
from meshkit.data import load_shipped
from meshkit.metrics import pmd
from meshkit.models import load_pretrained
from meshkit.viz import contact_sheet, error_colors, render

OUTPUT = Path(__file__).parents[1] / "docs" / "images" / "shipped_weights.png"
WORST = 0.15  # of the error's colours
ROWS = (  # weights, body, rows of the list of test pairs
    ("corenet3d-humans", "humans", (1, 10)),
    ("xdualnet-humans", "humans", (9, 48)),
    ("xdualnet-animals", "animals", (3, 12)),
)


@torch.no_grad()
def main() -> None:
    pictures, captions = [], []
    for name, kind, rows in ROWS:
        net, (body, split) = load_pretrained(name), load_shipped(kind)
        sides = {"identity_faces": body.faces, "pose_faces": body.faces}
        for row in rows:
            who, how, other, wanted = split.test_pairs[row][:, None]
            identity, pose, truth = body(who, how), body(other, wanted), body(who, wanted)
            output = net.output(identity, pose, **sides)
            meshes = [center(v)[0] for v in (identity, pose, output.warped, output.vertices, truth)]
            everything = torch.cat(meshes)
            bounds = torch.stack([everything.amin(0), everything.amax(0)])
            error = error_colors((meshes[3] - meshes[4]).norm(dim=1), vmax=WORST)
            views = [*((verts, None) for verts in meshes), (meshes[3], error)]
            pictures.append(
                [render(v, body.faces, colors=colors, bounds=bounds, size=(240, 240)) for v, colors in views]
            )
            score = 1e3 * float(pmd(meshes[3][None], meshes[4][None]))
            captions.append([name, "", "", f"PMD {score:.1f}e-3", "", ""])
    titles = ["identity", "pose", "warped", "output", "ground truth", "error"]
    bar = (0.0, 100 * WORST, "distance to ground truth (cm)")
    sheet = contact_sheet(pictures, column_titles=titles, captions=captions, colorbar=bar)
    sheet.quantize(128).save(OUTPUT, optimize=True)


if __name__ == "__main__":
    main()
