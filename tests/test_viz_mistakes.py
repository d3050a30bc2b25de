"""Bad input of the writers of pictures and pages: one line of ours, and nothing written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from meshkit.io import atomic_write
from meshkit.viz import (
    contact_sheet,
    correspondence_figure,
    error_heat_map,
    plot_curves,
    render,
    save_animation,
    save_html,
    turntable,
)

VERTS, FACES = torch.rand(10, 3, generator=torch.Generator().manual_seed(0)), torch.tensor([[0, 1, 2], [3, 4, 5]])
HOLED = VERTS.clone()
HOLED[3, 1] = torch.nan
PICTURE = np.zeros((30, 30, 3), np.uint8)
NAN = float("nan")
AXES = {"xlabel": "x", "ylabel": "y"}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: render(VERTS, FACES, azimuth=NAN), "azimuth and elevation must be finite degrees, got nan and 8.0"),
        (lambda _: render(VERTS, FACES, size=(32.5, 32)), r"two whole numbers, got \(32\.5, 32\)"),
        (lambda _: render(VERTS, FACES, size=32), "two whole numbers, got 32"),
        (lambda _: render(VERTS, FACES, size=(32,)), r"two whole numbers, got \(32,\)"),
        (lambda _: render(VERTS, FACES, background=(1, 1)), r"background must be RGB in \[0, 1\], got \(1, 1\)"),
        (lambda _: render(VERTS, FACES, background=(NAN, 1, 1)), "background must be RGB"),
        (lambda _: render(VERTS, FACES + 0.5), "faces must be whole numbers"),
        (lambda _: render(VERTS, FACES * NAN), "faces must be whole numbers"),
        (lambda _: render([[0, 0, 0], [1]], FACES), "an array of numbers is needed, got list"),
        (lambda _: render(HOLED, FACES), "1 of 10 vertices has NaN or infinite coordinates"),
        (lambda f: save_html(f / "a.html", {"body": (HOLED, FACES)}), "mesh 'body': 1 of 10 vertices has NaN"),
        (lambda f: save_html(f / "a.html", {"x": (VERTS, FACES[:0])}), "mesh 'x': nothing to draw: 10 vertices and 0"),
        (lambda f: save_html(f / "a.html", {"x": (VERTS, FACES)}, azimuth=NAN), "azimuth and elevation must be finite"),
        (lambda f: save_html(f / "a.glb", {"x": (VERTS, FACES)}), r"a page is written as \.html, got 'a\.glb'"),
        (lambda f: save_html(f / "a.html", {3: (VERTS, FACES)}), "the names of meshes must be text, got 3"),
        (lambda f: save_html(f / "a.html", {"x": (VERTS, FACES)}, notes="n"), "a line for each of 1 meshes, got 'n'"),
        (
            lambda f: save_animation(f / "a.gif", [PICTURE], seconds=NAN),
            "seconds must be 0.02 or more, and 655 at most",
        ),
        (
            lambda f: save_animation(f / "a.gif", [PICTURE], seconds=1e4),
            "seconds must be 0.02 or more, and 655 at most",
        ),
        (lambda f: save_animation(f / "a.gif", [PICTURE[:0]]), r"of one size, got uint8 \(0, 30, 3\)"),
        (lambda _: turntable(VERTS, FACES, size=(0, 9)), r"size must be at least 1, got \(0, 9\)"),
        (lambda _: turntable(VERTS, FACES, elevation=NAN), "must be finite degrees"),
        (lambda f: plot_curves(f / "a.pdf", {"a": ([1], [2])}, **AXES), r"curves are written as \.png, got 'a\.pdf'"),
        (lambda f: plot_curves(f / "a.png", {"a": [1, 2, 3]}, **AXES), r"curve 'a' must be \(x values, y values\)"),
        (lambda f: plot_curves(f / "a.png", {"a": (["x"], [1])}, **AXES), "an array of numbers is needed, got list"),
        (
            lambda _: error_heat_map(VERTS, FACES, -torch.ones(10)),
            "errors must be 0 or more, the least is -1; give",
        ),
        (lambda _: correspondence_figure(VERTS, (VERTS, FACES), range(10)), r"mesh 'source' must be \(verts, faces\)"),
        (lambda _: correspondence_figure((VERTS, FACES), (HOLED, FACES), range(10)), "mesh 'target': 1 of 10 vertices"),
        (lambda _: contact_sheet([[None]], column_titles=["a"]), "a contact sheet needs a picture, got none"),
    ],
)
def test_bad_input_is_one_line(call: Callable[[Path], Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        call(tmp_path)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "write",
    [
        lambda path: save_html(path.with_suffix(".html"), {"x": (VERTS, FACES)}),
        lambda path: save_animation(path.with_suffix(".gif"), [PICTURE]),
        lambda path: plot_curves(path.with_suffix(".png"), {"a": ([1], [2])}, **AXES),
    ],
)
def test_places_that_cannot_be_written_are_named(write: Callable[[Path], None], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(NotADirectoryError) as caught:
        write(tmp_path / "file" / "a")
    assert caught.value.filename == str(tmp_path / "file")
    for suffix in (".html", ".gif", ".png"):
        (tmp_path / f"b{suffix}").mkdir()
    with pytest.raises(IsADirectoryError) as caught_too:
        write(tmp_path / "b")
    assert Path(caught_too.value.filename).stem == "b"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.gif", "b.html", "b.png", "file"]


@pytest.mark.filterwarnings("error")
def test_curves_without_a_value_above_0_have_a_plain_axis(tmp_path: Path) -> None:
    plot_curves(tmp_path / "a.png", {"loss": ([1, 2], [0, 0])}, **AXES, logy=True)
    assert (tmp_path / "a.png").stat().st_size > 0


def test_atomic_write_to_a_folder_makes_nothing(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    with pytest.raises(IsADirectoryError), atomic_write(tmp_path / "runs") as temporary:
        temporary.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
