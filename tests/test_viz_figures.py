"""Figures, animations and pages: what is where, in which colour; and that a browser draws the page."""

import base64
import html
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from meshkit.data import load_humans
from meshkit.transfer import save_page, transfer_pose
from meshkit.viz import (
    correspondence_figure,
    error_colors,
    error_heat_map,
    position_colors,
    render,
    render_pyvista,
    save_animation,
    save_html,
    transfer_colors,
    turntable,
)
from meshkit.viz._mesh import fit_view

BODY = load_humans(1000)
VERTS = BODY(torch.tensor([3, 50]), torch.tensor([10, 500]))
SPHERE = trimesh.creation.icosphere(subdivisions=3)
RED, GREEN, BLUE = np.eye(3)


def test_position_colors_are_smooth_and_distinct() -> None:
    colors = position_colors(BODY.template)
    assert colors.shape == (1000, 3) and colors.min() >= 0 and colors.max() <= 1
    edges = torch.cat([BODY.faces[:, [0, 1]], BODY.faces[:, [1, 2]]]).numpy()
    steps = np.abs(colors[edges[:, 0]] - colors[edges[:, 1]]).max(1)
    assert np.percentile(steps, 99) < 0.35 and np.ptp(colors, axis=0).min() > 0.6
    far = np.linalg.norm(BODY.template.numpy()[:, None] - BODY.template.numpy()[None], axis=2) > 1.0
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2)
    assert (apart[far] < 0.05).mean() < 0.01
    assert np.isfinite(position_colors(np.zeros((3, 3)))).all()
    with pytest.raises(ValueError, match=r"finite \(V, 3\) .* got shape \(3,\)"):
        position_colors([0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        position_colors(np.full((2, 3), np.nan))


def test_colours_follow_hard_and_soft_matches() -> None:
    matches = torch.tensor([2, 0, 0])
    np.testing.assert_array_equal(transfer_colors(np.eye(3), matches), np.eye(3)[[2, 0, 0]])
    weights = torch.tensor([[0.0, 2.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(transfer_colors(np.eye(3), weights), [[0, 1, 0], [0.5, 0, 0.5], [0.5, 0.5, 0.5]])
    one_hot = torch.nn.functional.one_hot(matches, 3)
    np.testing.assert_allclose(transfer_colors(np.eye(3), one_hot), transfer_colors(np.eye(3), matches))


@pytest.mark.parametrize(
    ("colors", "matches", "message"),
    [
        (np.eye(3)[:, :2], [0], r"colors must be \(M, 3\), got \(3, 2\)"),
        (np.eye(3), [3], r"vertex numbers in \[0, 3\)"),
        (np.eye(3), [-1], "vertex numbers"),
        (np.eye(3), [0.5], "vertex numbers"),
        (np.eye(3), [[1.0, 0.0]], r"soft matches must be \(N, 3\) weights"),
        (np.eye(3), [[1.0, 0.0, -1.0]], "0 or more"),
    ],
)
def test_bad_matches_are_named(colors: Any, matches: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transfer_colors(colors, matches)


def test_correspondence_figure_puts_bodies_and_lines_in_place() -> None:
    """Two spheres, all vertices matched to the one on the right that faces the viewer."""
    front = int(SPHERE.vertices[:, 1].argmin())
    mesh = (SPHERE.vertices, SPHERE.faces)
    options = {"size": (100, 120), "azimuth": 0, "elevation": 0}
    gray = np.full((len(SPHERE.vertices), 3), 0.5)
    identity = np.arange(len(gray))
    plain = np.asarray(correspondence_figure(mesh, mesh, identity, colors=gray, lines=0, **options))
    assert plain.shape == (120, 200, 3)
    np.testing.assert_array_equal(plain[:, :100], plain[:, 100:])  # one scale, one place
    expected = render(*mesh, colors=gray, size=(100, 120), azimuth=0, elevation=0, supersample=3)
    np.testing.assert_array_equal(plain[:, :100], expected)

    to_front = np.full(len(gray), front)
    wrong = correspondence_figure(mesh, mesh, to_front, correct=np.zeros(len(gray)), colors=gray, lines=12, **options)
    red = (np.asarray(wrong).astype(int) @ [1, -1, 0]) > 60
    center = fit_view(SPHERE.vertices, (100, 120), azimuth=0, elevation=0, up="z").project(SPHERE.vertices[[front]])[0]
    assert red[int(center[1]), 100 + int(center[0])]  # all lines end there
    between = red[:, 100:104].any(1)
    assert between.any()
    right = correspondence_figure(mesh, mesh, to_front, colors=gray, lines=12, **options)
    assert not ((np.asarray(right).astype(int) @ [1, -1, 0]) > 60).any()


def test_bodies_of_different_units_are_both_seen() -> None:
    mesh, large = (SPHERE.vertices, SPHERE.faces), (100 * SPHERE.vertices, SPHERE.faces)
    options = {"size": (100, 120), "lines": 0, "colors": np.full((len(SPHERE.vertices), 3), 0.5)}
    figure = np.asarray(correspondence_figure(mesh, large, np.arange(len(SPHERE.vertices)), **options))
    ink = [float((side.min(-1) < 200).mean()) for side in (figure[:, :100], figure[:, 100:])]
    assert min(ink) > 0.3 and abs(ink[0] - ink[1]) < 0.01


def test_lines_join_visible_points_only() -> None:
    mesh = (SPHERE.vertices, SPHERE.faces)
    mirrored = np.array([np.linalg.norm(SPHERE.vertices - p * [1, -1, 1], axis=1).argmin() for p in SPHERE.vertices])
    options = {"size": (100, 100), "azimuth": 0, "elevation": 0, "colors": np.full((len(mirrored), 3), 0.5)}
    lineless = np.asarray(correspondence_figure(mesh, mesh, mirrored, lines=0, **options)).astype(int)
    backs = np.asarray(correspondence_figure(mesh, mesh, mirrored, lines=20, **options)).astype(int)
    own = np.asarray(correspondence_figure(mesh, mesh, np.arange(len(mirrored)), lines=20, **options)).astype(int)
    # What is seen on the left has its match on the hidden side; only the rim is seen in both.
    inner = np.hypot(*np.meshgrid(np.arange(100) - 49.5, np.arange(100) - 49.5)) < 32
    touched = [(picture != lineless)[:, :100][inner].any(-1).mean() for picture in (own, backs)]
    dots = [(np.abs(picture - lineless)[:, :100][inner].max(-1) > 60).mean() for picture in (own, backs)]
    assert touched[0] > 0.02 and dots[0] > 2 * dots[1]


def test_correspondence_figure_with_titles_and_bad_input() -> None:
    one, two = ((v, BODY.faces) for v in VERTS)
    figure = correspondence_figure(one, two, torch.arange(1000), size=(90, 120), titles=["identity", "pose"])
    assert figure.size == (180, 128)
    assert (np.asarray(figure)[:8].min(-1) < 120).any()  # ink of the titles
    cases = [
        ({"matches": torch.arange(999)}, "1000 source vertices, but 999 matches"),
        ({"matches": torch.arange(1, 1001)}, r"vertex numbers in \[0, 1000\)"),
        ({"correct": [True]}, r"correct of shape \(1,\)"),
        ({"lines": -1}, "lines must be 0 or more"),
        ({"titles": ["one"]}, "titles two"),
        ({"source": (VERTS[0] * np.nan, BODY.faces)}, "NaN"),
        ({"up": "x"}, "up must be"),
    ]
    for change, message in cases:
        with pytest.raises(ValueError, match=message):
            correspondence_figure(**{"source": one, "target": two, "matches": torch.arange(1000), **change})


def test_error_heat_map_shows_the_errors() -> None:
    errors = np.where(SPHERE.vertices[:, 1] < 0, 0.0, 1.0)  # the back is wrong
    figure = error_heat_map(
        SPHERE.vertices, SPHERE.faces, errors, azimuths=[0, 180], elevation=0, size=(80, 80), vmax=1
    )
    picture = np.asarray(figure).astype(int)
    dark = [picture[20:90, 20:80].mean(), picture[20:90, 110:160].mean()]
    assert dark[0] > dark[1] + 40
    assert figure.width > 2 * 80 and figure.height > 80
    top = np.rint(error_colors([1.0], vmax=1)[0] * 255)
    assert (picture == top).all(-1).any()  # the colour bar
    error_heat_map(SPHERE.vertices, SPHERE.faces, np.zeros(len(errors)), azimuths=[0], size=(20, 20))
    cases = [
        ({"errors": errors[:5]}, r"errors must be 642 finite numbers, one per vertex, got shape \(5,\)"),
        ({"errors": errors * np.nan}, "finite"),
        ({"vmax": 0}, "vmax must be above 0"),
        ({"azimuths": []}, "0 titles for 0 views"),
        ({"titles": ["a", "b"]}, "2 titles for 3 views"),
    ]
    for change, message in cases:
        with pytest.raises(ValueError, match=message):
            error_heat_map(**{"verts": SPHERE.vertices, "faces": SPHERE.faces, "errors": errors, **change})


def test_turntable_turns_in_place() -> None:
    frames = turntable(VERTS[1], BODY.faces, frames=4, size=(60, 80))
    single = [render(VERTS[1], BODY.faces, size=(60, 80), azimuth=a).shape for a in (0, 90)]
    assert [f.shape for f in frames] == [*single, *single]
    masks = [(f != 255).any(-1) for f in frames]
    for mask in masks:  # never cut off
        assert mask.any() and not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
    rows = np.array([np.flatnonzero(mask.any(1))[[0, -1]] for mask in masks])
    assert np.ptp(rows, axis=0).max() <= 5  # head and feet stay level, but for the tilt of the camera
    front, back = masks[0], masks[2]
    level = [(f != 255).any(-1) for f in turntable(VERTS[1], BODY.faces, frames=2, size=(60, 80), elevation=0)]
    assert (level[0] == level[1][:, ::-1]).mean() > 0.98  # front and back have mirrored outlines
    assert (front != back).any()
    upright = VERTS[1] @ torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    again = turntable(upright, BODY.faces, frames=4, size=(60, 80), up="y")
    assert np.abs(np.stack(again).astype(int) - np.stack(frames)).mean() < 0.5
    quarter = turntable(VERTS[1], BODY.faces, frames=4, size=(60, 80), azimuth=90)
    assert np.abs(np.stack(quarter).astype(int) - np.stack([*frames[1:], frames[0]])).mean() < 0.1
    with pytest.raises(ValueError, match="a frame or more, got 0"):
        turntable(VERTS[1], BODY.faces, frames=0)
    with pytest.raises(ValueError, match="nothing to draw"):
        turntable(VERTS[1], BODY.faces[:0])


def test_animations_keep_frames_and_colours(tmp_path: Path) -> None:
    frames = turntable(VERTS[0], BODY.faces, frames=5, size=(60, 80), colors=position_colors(VERTS[0]))
    save_animation(tmp_path / "new" / "turn.gif", frames, seconds=0.1)
    with Image.open(tmp_path / "new" / "turn.gif") as movie:
        assert (movie.n_frames, movie.size, movie.info["loop"], movie.info["duration"]) == (5, (60, 80), 0, 100)
        for number, frame in enumerate(frames):
            movie.seek(number)
            shown = np.asarray(movie.convert("RGB")).astype(int)
            assert np.abs(shown - frame).mean() < 3
            assert np.abs(shown[:3] - 255).max() <= 3  # the background stays white
    save_animation(tmp_path / "once.gif", [Image.fromarray(frames[0]), Image.fromarray(frames[1])], loop=False)
    with Image.open(tmp_path / "once.gif") as movie:
        assert "loop" not in movie.info
    cases = [
        ("a.gif", [], {}, "no frames"),
        ("a.png", frames, {}, r"written as \.gif, got 'a\.png'"),
        ("a.gif", frames, {"seconds": 0}, "seconds must be 0.02 or more"),
        ("a.gif", [frames[0], frames[1][1:]], {}, r"one size, got uint8 \(79, 60, 3\), uint8 \(80, 60, 3\)"),
        ("a.gif", [frames[0] / 255], {}, "must be uint8"),
    ]
    for name, pictures, options, message in cases:
        with pytest.raises(ValueError, match=message):
            save_animation(tmp_path / name, pictures, **options)


def test_a_colour_that_one_frame_only_has_is_kept(tmp_path: Path) -> None:
    ramp = np.linspace(0, 255, 80).astype(np.uint8)
    plain = np.stack(np.broadcast_arrays(ramp[:, None], ramp[None, :60], np.uint8(128)), axis=2)
    frames = [np.roll(plain, number, axis=1) for number in range(36)]
    patch = np.array([255, 0, 0])
    frames[17][30:40, 20:30] = patch
    save_animation(tmp_path / "patch.gif", frames)
    with Image.open(tmp_path / "patch.gif") as movie:
        movie.seek(17)
        shown = np.asarray(movie.convert("RGB")).astype(int)
    assert np.abs(shown[30:40, 20:30] - patch).max() <= 8


@pytest.fixture
def page(tmp_path: Path) -> Path:
    colors = {"</script><b>pose & co": np.tile(RED, (1000, 1))}
    meshes = {"identity": (VERTS[0], BODY.faces), "</script><b>pose & co": (VERTS[1], BODY.faces)}
    save_html(tmp_path / "new" / "page.html", meshes, colors=colors, title="two <bodies>", notes=["one", "<i>"])
    return tmp_path / "new" / "page.html"


def script(text: str, name: str) -> str:
    found = re.findall(rf'<script id="{name}" type="[^"]*">(.*?)</script>', text, re.DOTALL)
    assert len(found) == 1
    return found[0]


def test_marks_in_names_stay_as_they_are(tmp_path: Path) -> None:
    save_html(tmp_path / "@GLB@.html", {"@GLB@ @TITLE@": (VERTS[0], BODY.faces)}, title="@VIEW@ \\1")
    text = (tmp_path / "@GLB@.html").read_text()
    assert "<title>@VIEW@ \\1</title>" in text
    assert json.loads(script(text, "view"))["names"] == ["@GLB@ @TITLE@"]
    assert base64.b64decode(script(text, "glb"), validate=True)[:4] == b"glTF"


def test_pages_hold_their_meshes_and_need_no_network(page: Path) -> None:
    text = page.read_text()
    assert "<title>two &lt;bodies&gt;</title>" in text
    assert not re.search(r"(src|href)=", text)  # nothing to fetch
    assert (
        "https:" not in text
        and "http:" not in text
        and "@" not in re.sub(r"[A-Za-z0-9+/=]{500,}", "", text).replace("@media", "")
    )
    assert "default-src 'none'" in text
    view = json.loads(script(text, "view"))
    assert view["names"] == ["identity", "</script><b>pose & co"] and view["notes"] == ["one", "<i>"]
    glb = base64.b64decode(script(text, "glb"), validate=True)
    scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False)
    nodes = [scene.graph[name][1] for name in view["names"]]
    for node, verts in zip(nodes, VERTS, strict=True):
        mesh = scene.geometry[node]
        np.testing.assert_array_equal(np.asarray(mesh.vertices, dtype=np.float32), verts.numpy())
        np.testing.assert_array_equal(mesh.faces, BODY.faces.numpy())
    assert (scene.geometry[nodes[1]].visual.vertex_colors[:, :3] == [255, 0, 0]).all()
    assert len(text.splitlines()) < 300


def test_bad_pages_are_named(tmp_path: Path) -> None:
    good = {"a": (VERTS[0], BODY.faces)}
    cases = [
        ({}, {}, "meshes is empty"),
        (good, {"colors": {"b": VERTS[0]}}, r"colors for \['b'\], but the meshes are \['a'\]"),
        (good, {"colors": {"a": VERTS[0] - 10}}, r"values in \[0, 1\]"),
        (good, {"notes": []}, r"a line for each of 1 meshes, got \[\]"),
        (good, {"up": "x"}, "up must be 'y' or 'z'"),
        ({"a": (VERTS[0], BODY.faces + 1)}, {}, "but there are 1000 vertices"),
        ((VERTS[0], BODY.faces), {}, "meshes must be a dict by name.* got tuple"),
        ({"a": VERTS[0]}, {}, r"mesh 'a' must be \(verts, faces\), got Tensor"),
    ]
    for meshes, options, message in cases:
        with pytest.raises(ValueError, match=message):
            save_html(tmp_path / "page.html", meshes, **options)
    assert list(tmp_path.iterdir()) == []


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def screenshot(page: Path, folder: Path, size: tuple[int, int]) -> np.ndarray:
    """What a browser without a network shows."""
    shot = folder / "shot.png"
    flags = "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
    flags += " --disable-background-networking --no-first-run --disable-sync --hide-scrollbars"
    command = [str(CHROMIUM), *flags.split(), f"--window-size={size[0]},{size[1]}", "--virtual-time-budget=4000"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}"]
    subprocess.run([*command, f"--screenshot={shot}", page.as_uri()], check=True, capture_output=True, timeout=120)
    return np.asarray(Image.open(shot).convert("RGB")).astype(int)


def outline(mask: np.ndarray) -> np.ndarray:
    """The mask, cut to what it holds, in a common size."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    crop = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return np.asarray(Image.fromarray(crop).resize((60, 120)))


def clay(picture: np.ndarray) -> np.ndarray:
    """Where a body without colours of its own is drawn."""
    return (picture @ [-1, 0, 1] > 15) & (picture.min(-1) > 30)


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_draws_the_page(page: Path, tmp_path: Path) -> None:
    """Both bodies are drawn from within a file, in their colours, as the NumPy renderer draws them."""
    picture = screenshot(page, tmp_path, (600, 500))[60:-40]
    left = clay(picture)
    red = (picture @ [1, -1, 0] > 60) & (picture[..., 1] < 90)
    assert left[:, :300].mean() > 0.03 and left[:, 300:].mean() < 0.005
    assert red[:, 300:].mean() > 0.03 and red[:, :300].mean() < 0.005
    own = (render(VERTS[1], BODY.faces, size=(300, 400)) != 255).any(-1)
    assert (outline(own) == outline(red[:, 300:])).mean() > 0.95


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.parametrize(("size", "in_a_row"), [((1100, 800), True), ((500, 1100), False)])
def test_three_bodies_stand_in_one_row_or_one_column(size: tuple[int, int], in_a_row: bool, tmp_path: Path) -> None:
    """Bodies so wide that two rows would show them larger: there is no empty place, and no name over a body."""
    wide = VERTS[0] * torch.tensor([2.5, 1.0, 1.0])
    names = ("identity", "pose", "result")
    notes = ["one.obj", "two.obj", "a note that takes more than one line " * 8]
    save_html(tmp_path / "page.html", {name: (wide, BODY.faces) for name in names}, notes=notes)
    picture = screenshot(tmp_path / "page.html", tmp_path, size)
    drawn = clay(picture)
    thirds = np.array_split(drawn, 3, axis=1)
    shares = [third.mean() for third in thirds]
    if in_a_row:
        assert min(shares) > 0.03
        rows = [np.flatnonzero(third.any(1)) for third in thirds]
        assert np.ptp([row[0] for row in rows]) <= 1 and np.ptp([row[-1] for row in rows]) <= 1
    else:
        assert shares[1] > 3 * max(shares[0], shares[2])
        edges = np.flatnonzero(np.diff(np.r_[0, drawn.any(1).astype(int), 0]))
        begins, ends = edges[::2], edges[1::2]
        assert len(begins) == 3 and np.ptp(np.diff(begins)) <= 1, "three bodies, one under the other"
        beside = (np.ptp(picture, axis=-1) < 30) & (picture.max(-1) < 150) & ~drawn.any(0)  # the note is wider
        assert beside[ends[1] : begins[2]].any() and not beside[begins[2] : ends[2]].any()


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_draws_a_transfer_in_a_frame_of_another_page(tmp_path: Path) -> None:
    """As in the documentation: identity, pose and result in thirds of the frame, on a page of another colour."""
    result = transfer_pose(*((v, BODY.faces) for v in VERTS), weights="corenet3d-humans", refine=False)
    save_page(tmp_path / "posed.html", result)
    text = html.escape((tmp_path / "posed.html").read_text(encoding="utf-8"))
    style = "position: absolute; left: 50px; top: 30px; border: 0"
    frame = f'<iframe srcdoc="{text}" width="600" height="440" style="{style}"></iframe>'
    outer = tmp_path / "outer.html"
    outer.write_text(f'<body style="background: #ffd700">{frame}</body>', encoding="utf-8")
    picture = screenshot(outer, tmp_path, (700, 500))
    around = np.ones(picture.shape[:2], bool)
    around[30:470, 50:650] = False
    assert (picture[around] == [255, 215, 0]).all()
    inside = picture[30:470, 50:650][95:-40]  # between the names and the footer
    assert (inside.min(-1) > 200).mean() > 0.5
    for number, (verts, faces) in enumerate(result.views):
        drawn = clay(inside[:, 200 * number : 200 * (number + 1)])
        expected = (render(verts, faces, size=(300, 400)) != 255).any(-1)
        assert drawn.mean() > 0.03
        assert (outline(expected) == outline(drawn)).mean() > 0.93


def test_pyvista_draws_what_numpy_draws() -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    options = {"size": (160, 200), "azimuth": 30.0, "elevation": 10.0}
    ours, theirs = (f(VERTS[0], BODY.faces, **options) for f in (render, render_pyvista))
    assert theirs.shape == ours.shape and theirs.dtype == np.uint8
    assert ((ours != 255).any(-1) != (theirs != 255).any(-1)).mean() < 0.03
    flat = render_pyvista(VERTS[0], BODY.faces, shading="flat", colors=np.tile(GREEN, (1000, 1)), **options)
    body = (flat != 255).any(-1)
    assert (flat[body].astype(int).argmax(1) == 1).mean() > 0.95
    with pytest.raises(ValueError, match="shading must be 'smooth' or 'flat'"):
        render_pyvista(VERTS[0], BODY.faces, shading="none")  # type: ignore[arg-type]


def test_missing_pyvista_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyvista", None)
    with pytest.raises(ImportError, match=r'pip install "meshkit-torch\[viz\]"'):
        render_pyvista(VERTS[0], BODY.faces)
    with pytest.raises(ValueError, match="nothing to draw"):
        render_pyvista(VERTS[0][:0], BODY.faces)
