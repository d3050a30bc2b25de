"""The renderer against closed forms: areas, depth order, colours, handedness, light; and the figures around it."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from meshkit.viz import contact_sheet, error_colors, plot_curves, render
from meshkit.viz._mesh import GAMMA
from meshkit.viz.rasterizer import _INSIDE

RED, GREEN, BLUE = np.eye(3)
FRONT = {"azimuth": 0.0, "elevation": 0.0}
SPHERE = trimesh.creation.icosphere(subdivisions=4)


def covered(picture: np.ndarray) -> np.ndarray:
    return (picture != 255).any(-1)


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean (column, row) of the pixels set."""
    row, column = np.nonzero(mask)
    return np.array([column.mean(), row.mean()])


@pytest.mark.parametrize(("size", "scale"), [((200, 200), 3.0), ((300, 180), 2.5)])
def test_silhouette_of_a_sphere_has_the_area_of_its_disc(size: tuple[int, int], scale: float) -> None:
    picture = render(SPHERE.vertices, SPHERE.faces, size=size, scale=scale, supersample=1)
    expected = np.pi * (min(size) / scale) ** 2
    assert covered(picture).sum() == pytest.approx(expected, rel=0.01)
    np.testing.assert_allclose(centroid(covered(picture)), (np.array(size) - 1) / 2, atol=0.5)


def test_there_are_no_holes_and_no_cracks() -> None:
    """Every pixel centre well inside the outline of a closed surface is covered, at each resolution."""
    for side in (31, 64, 257):
        mask = covered(render(SPHERE.vertices, SPHERE.faces, size=(side, side), scale=2.2, supersample=1))
        offset = np.arange(side) + 0.5 - side / 2
        radius = np.hypot(*np.meshgrid(offset, offset)) * 2.2 / side
        assert mask[radius < 0.99].all()
        assert not mask[radius > 1.0].any()


def test_matches_a_slow_transcription_pixel_by_pixel() -> None:
    """Nearest hit of a ray through each pixel centre, solved one triangle and one pixel at a time."""
    rng = np.random.default_rng(0)
    verts, colors = rng.uniform(-1, 1, (9, 3)), rng.uniform(0, 1, (9, 3))
    faces = rng.permutation(9).reshape(3, 3)
    side, scale = 24, 2.0
    bounds = [[-1, -1, -1], [1, 1, 1]]
    picture = render(verts, faces, colors=colors, size=(side, side), scale=scale, bounds=bounds, shading="none",
                     supersample=1, **FRONT)  # fmt: skip
    expected = np.ones((side, side, 3))
    for row in range(side):
        for column in range(side):
            x, z = (column + 0.5) * scale / side - 1, 1 - (row + 0.5) * scale / side
            nearest = np.inf
            for face in faces:
                a, b, c = verts[face]
                uv = np.linalg.solve(np.stack([(b - a)[[0, 2]], (c - a)[[0, 2]]], axis=1), np.array([x, z]) - a[[0, 2]])
                weights = np.array([1 - uv.sum(), *uv])
                y = weights @ verts[face][:, 1]
                if (weights >= 0).all() and y < nearest:  # the camera stands at -y
                    nearest, expected[row, column] = y, weights @ colors[face]
    np.testing.assert_allclose(picture / 255, expected, atol=0.5 / 255 + 1e-9)
    assert covered(picture).sum() > 40


def test_nearer_triangle_hides_the_farther_in_any_order() -> None:
    square = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    verts = np.concatenate([square, square * 0.5 + [0, -1, 0]])  # the small one is in front: towards -y
    colors = np.repeat([RED, GREEN], 4, axis=0)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    for order in (faces, faces[::-1]):
        picture = render(verts, order, colors=colors, size=(40, 40), scale=2.0, shading="none", **FRONT)
        assert (picture[20, 20] == GREEN * 255).all()
        assert (picture[2, 2] == RED * 255).all()
        assert (picture[..., 1] == 255).sum() == 20 * 20
        behind = render(verts, order, colors=colors, size=(40, 40), scale=2.0, shading="none", azimuth=180, elevation=0)
        assert (behind == RED * 255).all()


def test_colours_interpolate_linearly() -> None:
    verts = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    ramp = (verts[:, :1] + 1) / 2 * np.ones(3)
    picture = render(verts, [[0, 1, 2], [0, 2, 3]], colors=ramp, size=(64, 8), scale=0.25, shading="none", **FRONT)
    expected = 255 * (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose(picture[4, :, 0], expected, atol=1)


def spike(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit sphere with one red vertex patch around ``direction``."""
    near = SPHERE.vertices @ direction > 0.9
    return SPHERE.vertices, np.where(near[:, None], RED, BLUE)


@pytest.mark.parametrize(
    ("direction", "view", "place"),
    [
        ((1, 0, 0), {"azimuth": 20, "elevation": 0}, (1, 0)),  # the body's left hand is on the right of the picture
        ((0, 0, 1), {"azimuth": 0, "elevation": 20}, (0, -1)),  # up is up
        ((0, -1, 0), {"azimuth": 0, "elevation": 0}, (0, 0)),  # the front faces the camera
        ((0, -1, 0), {"azimuth": 40, "elevation": 0}, (-1, 0)),  # the camera walks to the body's left
        ((0, -1, 0), {"azimuth": 0, "elevation": 40}, (0, 1)),  # and rises
        ((1, 0, 0), {"azimuth": 90, "elevation": 0}, (0, 0)),
        ((0, 0, 1), {"azimuth": 0, "elevation": 0, "up": "y"}, (0, 0)),  # with y up the front is +z
        ((0, 1, 0), {"azimuth": 0, "elevation": 20, "up": "y"}, (0, -1)),
        ((1, 0, 0), {"azimuth": 20, "elevation": 0, "up": "y"}, (1, 0)),
    ],
)
def test_orientation(direction: tuple[int, ...], view: dict, place: tuple[int, int]) -> None:
    verts, colors = spike(np.array(direction))
    picture = render(verts, SPHERE.faces, colors=colors, size=(101, 101), shading="none", **view)
    red = (picture[..., 0] > 128) & (picture[..., 2] < 128)
    assert red.any()
    np.testing.assert_array_equal(np.sign(np.rint((centroid(red) - 50) / 5)), place)


def test_light_comes_from_above_left_and_insides_are_dark() -> None:
    outside = render(SPHERE.vertices, SPHERE.faces, size=(60, 60)).mean(-1)
    inside = render(SPHERE.vertices, SPHERE.faces[:, ::-1], size=(60, 60)).mean(-1)
    assert outside[18, 18] > outside[30, 30] > outside[48, 48]
    assert (inside[10:50, 25:35] < outside[10:50, 25:35]).all()
    flat = render(SPHERE.vertices, SPHERE.faces, size=(60, 60), shading="flat").mean(-1)
    np.testing.assert_allclose(flat[10:50, 10:50], outside[10:50, 10:50], atol=8)  # a fine mesh: nearly equal


@pytest.mark.parametrize("shading", ["flat", "smooth"])
def test_faces_seen_from_inside_are_lit_as_from_outside_but_darker(shading: str) -> None:
    """An open box and the same with faces flipped: in linear light they differ by the factor, and by the highlight."""
    box = trimesh.creation.box()
    faces = box.faces[box.triangles_center[:, 2] < 0.49]  # without the lid
    view = {"colors": np.full((8, 3), 0.8), "shading": shading, "supersample": 1, "azimuth": 25, "elevation": 35}
    pictures = [render(box.vertices, f, **view)[..., 0] for f in (faces, faces[:, ::-1])]
    drawn = covered(render(box.vertices, faces, **view))
    outward, inward = ((picture[drawn] / 255) ** GAMMA for picture in pictures)
    assert (outward > inward).mean() > 0.2 < (outward < inward).mean()  # both sides of the walls are seen
    brighter, darker = np.maximum(outward, inward), np.minimum(outward, inward)
    np.testing.assert_allclose(darker, _INSIDE * brighter, atol=0.03)


def test_smooth_shading_hides_the_facets() -> None:
    coarse = trimesh.creation.icosphere(subdivisions=2)
    jump = {}
    for kind in ("flat", "smooth"):
        center = render(coarse.vertices, coarse.faces, size=(160, 160), shading=kind)[55:105, 55:105, 0]
        jump[kind] = np.abs(np.diff(center.astype(int))).max()
    assert 3 * jump["smooth"] < jump["flat"]


def test_shared_scale_and_bounds() -> None:
    bounds = [[-3, -3, -3], [3, 3, 3]]
    alone = covered(render(SPHERE.vertices, SPHERE.faces, supersample=1, **FRONT))
    half = covered(render(SPHERE.vertices / 2, SPHERE.faces, supersample=1, scale=2 * 1.08, **FRONT))
    assert half.sum() == pytest.approx(alone.sum() / 4, rel=0.02)
    shifted = SPHERE.vertices + np.array([1, 0, 0])
    moved = covered(render(shifted, SPHERE.faces, bounds=bounds, scale=6.0, size=(120, 120), **FRONT))
    np.testing.assert_allclose(centroid(moved), [59.5 + 20, 59.5], atol=0.3)
    np.testing.assert_allclose(centroid(alone), [159.5, 159.5], atol=0.3)


def test_whole_body_is_framed_in_any_picture_shape() -> None:
    verts = SPHERE.vertices * [1, 1, 3]
    for size in ((60, 200), (200, 60), (100, 100)):
        mask = covered(render(verts, SPHERE.faces, size=size, **FRONT))
        assert mask.shape == size[::-1]
        assert not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
        assert mask.any(1).mean() > 0.88 or mask.any(0).mean() > 0.88


def test_pictures_are_deterministic_and_inputs_untouched() -> None:
    verts, faces = torch.tensor(SPHERE.vertices).float().requires_grad_(), torch.tensor(SPHERE.faces)
    before = verts.detach().clone()
    assert (render(verts, faces) == render(verts, faces)).all()
    assert torch.equal(verts, before)


def test_supersampling_softens_the_outline_only() -> None:
    options = {"size": (80, 80), "scale": 2.5, "shading": "none", "colors": np.zeros_like(SPHERE.vertices)}
    hard = render(SPHERE.vertices, SPHERE.faces, supersample=1, **options)
    soft = render(SPHERE.vertices, SPHERE.faces, supersample=4, **options)
    assert set(np.unique(hard)) == {0, 255}
    assert len(np.unique(soft)) > 10
    assert (255.0 - soft).sum() == pytest.approx(255 * 3 * np.pi * (80 / 2.5) ** 2, rel=0.005)


def test_degenerate_and_edge_on_faces_are_skipped() -> None:
    verts = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 5, 0]])
    faces = [[0, 1, 2], [0, 2, 3], [1, 1, 2], [0, 1, 1]]
    picture = render(verts, faces, colors=np.zeros((5, 3)), scale=2.0, size=(20, 20), bounds=[[-1, 0, -1], [1, 0, 1]],
                     shading="none", **FRONT)  # fmt: skip
    assert (picture == 0).all()
    edge_on = render(verts[:4], faces[:2], azimuth=90, elevation=0)
    assert not covered(edge_on).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"verts": np.zeros((0, 3)), "faces": np.zeros((0, 3))}, "nothing to draw: 0 vertices and 0 faces"),
        ({"faces": np.zeros((0, 3))}, "nothing to draw: 3 vertices and 0 faces"),
        ({"verts": np.full((3, 3), np.nan)}, "3 of 3 vertices have NaN or infinite"),
        ({"verts": np.zeros((1, 3, 3))}, r"verts \(V, 3\) and faces \(F, 3\), got \(1, 3, 3\)"),
        ({"faces": [[0, 1, 2], [-1, -1, -1]]}, "face indices run from -1 to 2.* remove the padding first"),
        ({"faces": [[0, 1, 3]]}, "but there are 3 vertices"),
        ({"colors": np.zeros((2, 3))}, r"colors must be \(V, 3\) = \(3, 3\)"),
        ({"colors": np.full((3, 3), 255)}, r"values in \[0, 1\]"),
        ({"colors": np.full((3, 3), np.nan)}, r"values in \[0, 1\]"),
        ({"up": "x"}, "up must be 'y' or 'z', got 'x'"),
        ({"shading": "phong"}, "shading must be 'smooth', 'flat' or 'none', got 'phong'"),
        ({"size": (0, 10)}, r"at least 1, got \(0, 10\)"),
        ({"supersample": 0}, "at least 1"),
        ({"scale": 0.0}, "scale must be a length above 0"),
        ({"bounds": [[1, 1, 1], [0, 0, 0]]}, "bounds must be a finite"),
    ],
)
def test_bad_input_is_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render(**{"verts": np.eye(3), "faces": [[0, 1, 2]], **change})


def test_error_colors_are_ordered_by_lightness_and_clipped() -> None:
    colors = error_colors(torch.linspace(0, 2, 41), vmax=1.0)
    lightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:21]) < 0).all()
    assert (colors[20:] == colors[20]).all()
    np.testing.assert_array_equal(error_colors([0.3], vmax=1.0), error_colors([30.0], vmax=100.0))
    with pytest.raises(ValueError, match="finite"):
        error_colors([np.nan], vmax=1.0)
    with pytest.raises(ValueError, match="vmax must be above 0, got 0"):
        error_colors([1.0], vmax=0)


def picture_of(value: int, height: int = 40, width: int = 60) -> np.ndarray:
    return np.full((height, width, 3), value, dtype=np.uint8)


def test_contact_sheet_places_every_picture() -> None:
    values = [[10, 20, 30], [40, 50, 60]]
    rows = [[picture_of(v) for v in line] for line in values]
    sheet = np.asarray(
        contact_sheet(
            rows,
            column_titles=["a", "b", "a title that is much longer than its picture"],
            row_titles=["first", "second"],
            captions=[["1", "2", "3"], ["4", "5", "6"]],
            colorbar=(0.0, 0.5, "error (m)"),
        )
    )
    corners = []
    for line in values:
        for value in line:
            places = np.argwhere((sheet == value).all(-1))
            block = [tuple(p) for p in places if (sheet[p[0] : p[0] + 40, p[1] : p[1] + 60] == value).all()]
            assert len(block) == 1
            corners.append(block[0])
    grid = np.array(corners).reshape(2, 3, 2)
    assert len(np.unique(grid[:, :, 0])) == 2  # rows are level
    assert len(np.unique(grid[:, :, 1])) == 3  # columns are straight
    assert (sheet[:, -1] == 255).all() and (sheet[-1] == 255).all()  # nothing runs off the sheet
    ramp = np.rint(error_colors([0.0, 1.0], vmax=1.0) * 255).astype(np.uint8)
    low, high = (np.argwhere((sheet == color).all(-1)) for color in ramp)
    assert len(low) and len(high) and high[:, 0].mean() < low[:, 0].mean()  # large values are at the top


def test_contact_sheet_without_extras_and_with_gaps(tmp_path: Path) -> None:
    sheet = contact_sheet([[picture_of(7), None], [None, picture_of(9)]], column_titles=["x", "y"])
    sheet.save(tmp_path / "sheet.png")
    again = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert [(again == v).all(-1).sum() for v in (7, 9)] == [2400, 2400]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rows": []}, "needs a picture"),
        ({"rows": [[None, None]]}, "needs a picture"),
        ({"column_titles": ["a"]}, r"1 column titles for rows of \[2\] pictures"),
        ({"row_titles": ["a", "b"]}, "2 row titles for 1 rows"),
        ({"captions": [["a"]]}, "captions must have one line for every picture"),
        ({"rows": [[picture_of(0), picture_of(0, 41)]]}, r"one size, got uint8 \(40, 60, 3\), uint8 \(41, 60, 3\)"),
        ({"rows": [[picture_of(0), picture_of(0) / 255]]}, "must be uint8"),
    ],
)
def test_bad_sheets_are_named(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        contact_sheet(**{"rows": [[picture_of(0)] * 2], "column_titles": ["a", "b"], **arguments})


def test_plot_curves_writes_a_picture(tmp_path: Path) -> None:
    steps = np.arange(50)
    curves = {"falling": (steps, np.exp(-steps / 10)), "gap": (steps, np.where(steps == 7, np.nan, 0.5))}
    plot_curves(tmp_path / "new" / "loss.png", curves, xlabel="step", ylabel="loss", logy=True)
    picture = np.asarray(Image.open(tmp_path / "new" / "loss.png").convert("RGB"))
    falling, level = ((picture == color).all(-1) for color in ((0x3B, 0x6E, 0xA8), (0xD1, 0x60, 0x3D)))
    row, column = np.nonzero(falling[:, : picture.shape[1] // 2])  # left of the legend
    assert np.corrcoef(column, row)[0, 1] > 0.99  # an exponential is a straight descent on a logarithmic axis
    assert level.any()


@pytest.mark.parametrize(
    ("series", "message"),
    [
        ({}, "series is empty"),
        ({"a": ([1, 2], [1.0])}, r"curve 'a' needs as many x as y values .* shapes \(2,\) and \(1,\)"),
        ({"a": ([1], [np.nan])}, "and a finite point"),
    ],
)
def test_bad_curves_are_named(tmp_path: Path, series: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plot_curves(tmp_path / "loss.png", series, xlabel="x", ylabel="y")
