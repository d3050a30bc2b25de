"""Pose transfer between any two meshes: the way into the weights' frame and back, honesty, sequences, the command.

``Copy`` stands for weights where the way there and back is tested: its result is the identity mesh, so that the whole
transfer must be a rigid motion of the identity mesh into the frame and place of the pose mesh.
"""

import gc
import itertools
import json
import math
import os
import re
import struct
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from conftest import assert_near
from torch import Tensor, nn

import meshkit._transfer_command as front
import meshkit.transfer._choose as choose
from meshkit._names import did_you_mean, nearest
from meshkit._transfer_command import main, parser
from meshkit.batching import center
from meshkit.data import load_animals, load_humans, load_shipped
from meshkit.io import MeshFileError, load_mesh, save_mesh
from meshkit.metrics import pmd
from meshkit.models import GeneratorConfig, GeneratorOutput, PretrainedTransfer, pretrained_names
from meshkit.ot import sinkhorn
from meshkit.topology import vertex_normals
from meshkit.transfer import (
    Confidence,
    PoseTransfer,
    UnusablePosesError,
    _kinds,
    read_sequence,
    save_page,
    save_picture,
    sequence,
    transfer_pose,
    transfer_sequence,
    usual_range,
)
from meshkit.transfer._frames import axis_name, axis_vector, rotations, turn_up, turns_about
from meshkit.transfer._kinds import Likeness, guess_kind
from meshkit.transfer._open import named, open_mesh
from meshkit.transfer._openings import boundary_loops, find_openings
from meshkit.transfer._orient import RestBody
from meshkit.transfer._units import UNITS, find_scale, scale_to
from meshkit.transfer.confidence import roughness, row_entropies
from meshkit.transfer.report import Doubt

UPRIGHT = {"identity_up": "+z", "identity_facing": "-y", "pose_up": "+z", "pose_facing": "-y"}
Mesh = tuple[Tensor, Tensor]
WEIGHTS = "corenet3d-humans"
WIDE = {"edge_change": {"median": 0.0, "limit": 1.0}}  # nothing is unusual
BOUND = 1.5  # of PMD, in 1e-3 m²


class Copy(nn.Module):
    """A generator that leaves the identity as it is."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))

    def forward(self, identity, pose, **_):
        plan = sinkhorn(identity[:, :, :], pose[:, :, :])
        return GeneratorOutput(identity * self.scale, identity, plan)


def copier(**card) -> PretrainedTransfer:
    return PretrainedTransfer(Copy(), GeneratorConfig(k=1), card={"name": "copy", **card}).eval()  # type: ignore[arg-type]


def pretend_matching(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let weights pass for ones with a matching, where ``find_rotation``, which would match, is replaced."""
    monkeypatch.setattr(RestBody, "can_match", True)
    monkeypatch.setattr("meshkit.transfer._prepare.agrees", lambda *_, **__: True)


def body_of(resolution: int, identity: int, pose: int) -> Mesh:
    body = load_humans(resolution)
    return body(torch.tensor([identity]), torch.tensor([pose]))[0], body.faces


@pytest.fixture(scope="module")
def person() -> Mesh:
    return body_of(1000, 3, 10)


@pytest.fixture(scope="module")
def mover() -> Mesh:
    verts, faces = body_of(2000, 50, 500)
    return verts + torch.tensor([2.0, 1.0, 0.5]), faces


def y_up(verts: Tensor) -> Tensor:
    return torch.stack([verts[:, 0], verts[:, 2], -verts[:, 1]], 1)


def standing_point(verts: Tensor) -> Tensor:
    low, high = verts.amin(0), verts.amax(0)
    return torch.stack([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])


# Axes and units


def test_rotations_are_those_of_the_cube():
    found = rotations()
    assert len(found) == 24
    assert torch.equal(found[0], torch.eye(3))
    assert_near(found @ found.mT, torch.eye(3).expand(24, 3, 3), 1e-6)
    assert bool((torch.linalg.det(found) > 0).all())
    assert len({tuple(matrix.flatten().tolist()) for matrix in found}) == 24
    for up, facing in itertools.permutations(["+x", "-y", "+z"], 2):
        (matrix,) = rotations(up, facing)
        assert torch.equal(matrix @ axis_vector(up), torch.tensor([0.0, 0, 1]))
        assert torch.equal(matrix @ axis_vector(facing), torch.tensor([0.0, -1, 0]))
    assert len(rotations("+y")) == len(rotations(facing="-x")) == 4


def test_turning_up_is_the_least_rotation():
    axes = [axis_vector(sign + letter) for sign in "+-" for letter in "xyz"]
    for source, target in itertools.product(axes, axes):
        matrix = turn_up(source, target)
        assert torch.equal(matrix @ source, target)
        assert torch.linalg.det(matrix) == 1
        angle = math.acos((float(matrix.trace()) - 1) / 2)
        assert angle == pytest.approx(math.acos(float(source @ target)))


def test_quarter_turns_are_seven():
    start = rotations("+y", "+z")[0]
    near = turns_about(start)
    assert torch.equal(near[0], start) and len(near) == 7
    assert all(float((near[0].T @ turned).trace()) == pytest.approx(1) for turned in near[1:])


@pytest.mark.parametrize("unit", ["m", "cm", "mm", "in", "ft"])
def test_units_are_guessed_from_the_area(unit):
    metres = {"m": 1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}[unit]
    scale = find_scale(1.9 / metres**2, 1.8, None)
    assert (scale.unit, scale.fit) == (unit, 1.0)
    assert scale.factor == pytest.approx(metres)


def test_odd_sizes_are_scaled_to_the_reference():
    giant = find_scale(1.8 * 4, 1.8, "m")  # twice as tall
    assert giant.fit == pytest.approx(0.5)
    assert "scaled by 0.5" in str(giant)
    assert find_scale(1.8 * 1.2**2, 1.8, "m").fit == 1.0
    assert find_scale(1.8 * 7**2, 1.8, None).fit == pytest.approx(1 / (7 * 0.3048))  # nearest as 7 feet


def test_animals_are_never_taken_for_feet():
    animals = load_animals()
    upright = {"identity_up": "+z", "identity_facing": "-y"}
    for factor, unit in ((1.0, "m"), (3.0, "m"), (4.5, "m"), (0.3, "m"), (100.0, "cm"), (250.0, "cm")):
        mesh = (factor * animals.template, animals.faces)
        scale = PoseTransfer(mesh, weights=copier(data="animals"), **upright).identity.scale
        assert scale.unit == unit, factor


def test_impossible_axes_and_units_are_refused():
    with pytest.raises(ValueError, match="an axis is"):
        axis_vector("up")
    with pytest.raises(ValueError, match="right angles"):
        rotations("+z", "-z")
    with pytest.raises(ValueError, match="unit must be one of m, cm"):
        find_scale(1.0, 1.0, "inch")
    with pytest.raises(ValueError, match="no surface area"):
        find_scale(0.0, 1.0, None)


# There and back


def test_the_result_stands_where_the_pose_mesh_stands(person, mover):
    result = transfer_pose(person, mover, weights=copier(), **UPRIGHT)
    expected = person[0] - standing_point(person[0]) + standing_point(mover[0])
    assert_near(result.verts, expected, 1e-4)
    assert torch.equal(result.faces, person[1])


@pytest.mark.parametrize("frame", ["pose", "identity"])
def test_axes_and_units_there_and_back(person, mover, frame):
    """Identity in centimetres and y up, pose in metres and z up."""
    theirs = (100 * y_up(person[0]), person[1])
    axes = UPRIGHT | {"identity_up": "+y", "identity_facing": "+z"}
    result = transfer_pose(theirs, mover, weights=copier(), frame=frame, **axes)
    expected = person[0] - standing_point(person[0]) + standing_point(mover[0])
    assert_near(result.verts, expected if frame == "pose" else 100 * y_up(expected), 1e-4)
    assert (result.report.identity.scale.unit, result.report.pose.scale.unit) == ("cm", "m")


def test_a_body_of_odd_size_keeps_it(person, mover):
    result = transfer_pose((3 * person[0], person[1]), mover, weights=copier(), identity_unit="m", **UPRIGHT)
    assert result.report.identity.scale.fit < 0.5
    expected = 3 * (person[0] - standing_point(person[0])) + standing_point(mover[0])
    assert_near(result.verts, expected, 1e-4)


def test_loose_parts_and_unused_vertices_follow(person, mover):
    """An eye inside the head, a vertex of no face, a repeated vertex: all are in the result, moved along."""
    eye = trimesh.creation.icosphere(1, radius=0.02)
    verts, faces = person
    head = verts[verts[:, 2].argmax()] - torch.tensor([0.0, 0, 0.1])
    more = torch.cat([verts, torch.tensor(eye.vertices).float() + head, verts[:1], verts[1:2]])
    more_faces = torch.cat([faces, torch.tensor(eye.faces).long() + len(verts)])
    more_faces[0][more_faces[0] == faces[0, 0]] = faces[0, 0]
    result = transfer_pose((more, more_faces), mover, weights=copier(), **UPRIGHT)
    expected = more - standing_point(verts) + standing_point(mover[0])
    assert_near(result.verts, expected, 1e-3)
    assert any("smaller parts removed" in note for note in result.report.identity.notes)


def test_many_vertices_are_simplified_and_carried_back(mover):
    fine = body_of(6890, 3, 10)
    result = transfer_pose(fine, mover, weights=copier(), refine=False, **UPRIGHT)
    assert len(result.report.identity.simple.verts) == 1000
    assert_near(result.verts, fine[0] - standing_point(fine[0]) + standing_point(mover[0]), 1e-3)


def test_refining_keeps_the_identitys_lengths(person, mover):
    """A network that makes everything a tenth too large: refined towards it, edges are nearer to their lengths."""
    net = copier()
    nn.init.constant_(net.generator.scale, 1.1)
    changes = []
    for refine in (False, 0.1, 10.0):
        verts = transfer_pose(person, mover, weights=net, refine=refine, **UPRIGHT).verts
        edges = [(v[person[1][:, 0]] - v[person[1][:, 1]]).norm(dim=1) for v in (verts, person[0])]
        changes.append(float((edges[0] / edges[1]).mean()) - 1)
    assert changes[0] == pytest.approx(0.1, abs=1e-3)
    assert 0 < changes[1] < changes[2] < changes[0]


# Honesty


def test_row_entropies_are_those_of_the_distributions():
    plan = torch.tensor([[0.25, 0.25, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])
    assert_near(row_entropies(plan), torch.tensor([math.log(2), 0.0, 0.0, math.log(3)]), 1e-6)


def test_unusual_numbers_are_put_into_words():
    ordinary = [Confidence(0.01 * i, 0.5, 0.1, 0.2, None) for i in range(101)]
    usual = usual_range(ordinary)
    assert usual["match_spread"] == {"median": 0.5, "limit": 0.99}
    assert "pose_distance" not in usual
    assert Confidence(0.5, 0.5, 0.1, 0.2, 9.0).warnings(usual) == ()
    assert Confidence(None, None, 0.1, None, None).warnings(usual) == ()
    (text,) = Confidence(0.5, 0.1, 0.1, 0.2, None).warnings(usual)
    assert text.startswith(
        "few vertices of the two meshes are each other's best match: 10.0% (median 50.0%, 99 of 100 "
    )
    assert text.endswith(
        "above 50.0%); see that both are bodies of the kind that the weights know, and that their axes are right"
    )
    (text,) = Confidence(0.5, 0.5, 0.1, 0.3, None).warnings(usual)
    assert text.startswith(
        "the identity mesh's surface is unlike that of the training meshes: 0.300 (median 0.200, 99 of"
    )
    (text,) = Confidence(1.0, 0.5, 0.1, 0.2, None).warnings(usual)
    assert text.startswith(
        "the network is unsure which places of the two meshes correspond, so limbs may go astray; on "
    )
    assert "matches a vertex with this share of the pose mesh: 100.0% (median 50.0%" in text
    assert len(Confidence(2.0, 0.1, 0.9, 0.9, None).warnings(usual)) == 4
    rough = usual_range([Confidence(None, None, 0.1, None, None, 0.1, 0.1 + 0.001 * i) for i in range(101)])
    assert rough["pose_roughness"] == {"median": 0.15, "limit": 0.199} and "match_spread" not in rough
    texts = Confidence(None, None, 0.1, None, None, 0.2, 0.3).warnings(rough)
    assert [text[:25] for text in texts] == ["the identity mesh's surfa", "the pose mesh's surface i"]
    assert all(
        text.endswith(
            "noise of a scan, or too few vertices (fewer than the weights want): smooth the scan, or take a finer mesh"
        )
        for text in texts
    )
    with pytest.raises(ValueError, match="needs measured pairs"):
        usual_range([])


def test_the_report_says_what_was_done(person, mover):
    result = transfer_pose(
        person, mover, weights=copier(usual={"edge_change": {"median": 0.0, "limit": -1.0}}), **UPRIGHT
    )
    text = str(result.report)
    assert "simplified to 1000 vertices" in text and "frame    up +z, facing -y (given)" in text
    assert "UNUSUAL  the network changes the identity's edges much in length: 0.0%" in text
    assert result.report.confidence.edge_change == pytest.approx(0, abs=1e-5)
    assert result.report.confidence.identity_distance is None
    unjudged = transfer_pose(person, mover, weights=copier(), **UPRIGHT).report
    doubted = replace(unjudged, doubts=(Doubt("pose", "odd"),))
    assert "UNUSUAL  " in str(doubted) and "UNUSUAL  " not in str(unjudged)
    assert all("do not say what is usual" in str(report) for report in (unjudged, doubted))
    assert "what is usual" not in str(replace(doubted, calibrated=True))
    assert "all within what is usual" in str(transfer_pose(person, mover, weights=copier(usual=WIDE), **UPRIGHT).report)


def test_roughness_is_that_of_the_angles():
    grid = torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0))
    flat = torch.cat([grid, torch.zeros(9, 1)], 1)
    faces = torch.tensor([[0, 3, 1], [1, 3, 4], [3, 6, 4], [4, 6, 7], [1, 4, 2], [2, 4, 5], [4, 7, 5], [5, 7, 8]])
    assert roughness(flat, faces) == pytest.approx(0, abs=1e-6)
    assert roughness(flat, torch.cat([faces, torch.tensor([[0, 1, 2]])])) == pytest.approx(0, abs=1e-6)  # no area
    cube = trimesh.creation.box()
    points, triangles = torch.tensor(cube.vertices), torch.tensor(cube.faces)
    normals = vertex_normals(points, triangles)
    expected = [1 - float(normals[i] @ torch.tensor(cube.face_normals[f])) for f in range(12) for i in triangles[f]]
    assert roughness(points, triangles) == pytest.approx(sum(expected) / 36, rel=1e-6)
    body = body_of(6890, 3, 10)
    noise = torch.randn(body[0].shape, generator=torch.Generator().manual_seed(0))
    levels = []
    for size in (0.0, 0.005, 0.01):
        small = open_mesh((body[0] + size * noise, body[1]), "x").simplified(1000)
        levels.append(roughness(small.verts, small.faces))
    assert 0.09 < levels[0] < 0.15 < levels[1] < 0.2 < levels[2]


# People and animals


def test_people_and_animals_are_told_apart():
    for kind, poses in (("humans", (0, 400)), ("animals", (0, 200))):
        body, split = load_shipped(kind)
        for who, pose in itertools.product(split.test_identities[:4].tolist(), poses):
            verts = body(torch.tensor([who]), torch.tensor([pose]))[0]
            like = guess_kind(30 * y_up(verts), body.faces)
            assert (like.kind, like.clear, like.doubt) == (kind, True, "")


@pytest.mark.parametrize(("resolution", "who"), [(2000, 24), (2000, 40), (2000, 72), (3445, 172), (6890, 168)])
def test_bodies_once_taken_for_animals_are_people(resolution, who):
    small = open_mesh(body_of(resolution, who, 10), "identity")
    assert (small.likeness.kind, small.likeness.clear) == ("humans", True)


def test_a_shape_between_the_kinds_is_taken_for_a_person_in_doubt(person, monkeypatch):
    between = torch.tensor(_kinds._MEANS).double().mean(0)
    monkeypatch.setattr(_kinds, "shape_numbers", lambda *_: between)
    like = guess_kind(*person)
    assert (like.kind, like.clear, like.neither) == ("humans", False, False)
    assert like.score == pytest.approx(0, abs=1e-6)
    monkeypatch.setattr(choose, "pretrained_names", lambda: ["a", "b"])
    cards = {"a": "humans", "b": "animals"}
    monkeypatch.setattr(
        choose, "load_pretrained", lambda name: copier(name=name, data=cards[name], figures={"pmd": 1.0}, usual=WIDE)
    )
    result = transfer_pose(person, (person[0] + 0.1, person[1]), **UPRIGHT)
    said = "mesh has a shape between a person's and an animal's: name the weights of its kind if these are not"
    assert result.report.warnings == (f"the identity {said}", f"the pose {said}")
    text = str(result.report)
    assert "UNUSUAL  the identity mesh has a shape between" in text and "all within" not in text
    assert "weights  a, those for humans, as the identity's shape is unclear" in text
    assert text.count("unit unknown, scaled by ") == 2 and "if this is a body" not in text


def blob(kind: str) -> Mesh:
    if kind == "ball":
        mesh = trimesh.creation.icosphere(4)
    else:
        mesh = trimesh.creation.box((1, 1, 1 if kind == "box" else 0.01))
        for _ in range(4):
            mesh = mesh.subdivide()
    return torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).long()


@pytest.mark.parametrize("kind", ["ball", "box", "sheet"])
def test_what_is_no_body_is_neither_and_of_no_unit(kind, person):
    mesh = blob(kind)
    assert open_mesh(mesh, "x").likeness.neither
    why = choose.choose_weights("auto", lambda: open_mesh(mesh, "x")).why
    assert why.endswith("-humans, those for humans, as the identity's shape is of neither kind")
    net = copier(data="humans", usual=WIDE)
    for role, pair in (("identity", (mesh, person)), ("pose", (person, mesh))):
        report = transfer_pose(*pair, weights=net, **UPRIGHT).report
        (said,) = report.warnings
        assert said.startswith(f"the {role} mesh has the shape of neither a person nor a four-legged animal (distance ")
        assert said.endswith(
            "expect no sensible result; use one whole body as one surface, smoothed if it is a noisy scan, without "
            "clothes or props"
        )
        prepared = getattr(report, role)
        assert prepared.scale.unit == "unknown" and "unit unknown, scaled by " in str(prepared)
        assert "if this is a body" not in str(report) and "guessed" not in str(prepared)
        area = float(_kinds.surface_area(prepared.clean.verts, prepared.clean.faces))
        assert area == pytest.approx(float(_kinds.surface_area(*_kinds.rest_body("humans"))), rel=1e-3)
    given = transfer_pose(person, mesh, weights=net, pose_unit="cm", **UPRIGHT).report
    assert given.pose.scale.unit == "cm"


LIMITS = {name: {"median": 0.0, "limit": 0.0} for name in ("identity_roughness", "pose_roughness")}


def test_what_follows_from_a_mesh_of_no_kind_is_counted(person, mover, tmp_path, monkeypatch, capsys):
    """Of the pose, a ball: its roughness and what is about the two; not the roughness of the identity."""
    net = copier(data="humans", usual={**LIMITS, "edge_change": {"median": 0.0, "limit": -1.0}})
    report = transfer_pose(person, blob("ball"), weights=net, pose_unit="m", **UPRIGHT).report
    found = [(doubt.role, doubt.follows) for doubt in report.doubts]
    assert found == [("pose", False), ("pose", True), ("", True), ("identity", False), ("pose", True)]
    assert report.warnings[1].startswith("pose: far from the size of the training bodies in the unit given")
    said = [line for line in str(report).splitlines() if line.startswith("UNUSUAL")]
    assert len(said) == 2 and "neither a person" in said[0] and "identity mesh's surface is rough" in said[1]
    assert "3 further doubts follow from the kind of mesh: see the report's doubts, or --report FILE" in str(report)
    assert len(report.warnings) == 5 and len(report.as_dict()["doubts"]) == 5
    assert not any(doubt.follows for doubt in transfer_pose(person, mover, weights=net, **UPRIGHT).report.doubts)
    monkeypatch.setattr(choose, "load_weights", lambda *_: net)
    save_mesh(tmp_path / "id.obj", *person)
    save_mesh(tmp_path / "ball.obj", *blob("ball"))
    words = [*AXES, "--weights", "copy", *QUIET]
    command(tmp_path / "id.obj", tmp_path / "ball.obj", "-o", tmp_path / "x.obj", "--pose-unit=m", *words)
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 3 and error[2].startswith(f"unusual: {tmp_path / 'ball.obj'}: 3 further doubts follow")
    animals = load_animals()
    other = transfer_pose((animals.template, animals.faces), person, weights=net, **UPRIGHT).report
    assert {doubt.follows for doubt in other.doubts if doubt.role != "pose"} == {False, True}, "the other kind, too"
    assert not any(doubt.follows for doubt in other.doubts if doubt.role == "pose")


def test_one_mesh_as_identity_and_pose_is_doubted_once(person):
    net = copier(data="humans", usual=LIMITS)
    giant = (3 * person[0], person[1])
    units = {"identity_unit": "m", "pose_unit": "m"}
    report = transfer_pose(giant, (giant[0].clone(), giant[1]), weights=net, **units, **UPRIGHT).report
    assert [doubt.role for doubt in report.doubts] == ["", ""]
    assert [text[:30] for text in report.warnings] == [
        "far from the size of the train",
        "the mesh's surface is rough: 0",
    ]
    apart = transfer_pose(giant, (giant[0] + 0.1, giant[1]), weights=net, **units, **UPRIGHT).report
    assert [doubt.role for doubt in apart.doubts] == ["identity", "pose", "identity", "pose"]
    ball = transfer_pose(blob("ball"), blob("ball"), weights=copier(data="humans", usual=WIDE), **UPRIGHT).report
    assert [text[:30] for text in ball.warnings if "neither" in text] == ["the mesh has the shape of neit"]


def test_a_mesh_of_no_unit_keeps_its_size(person):
    """In its own frame; in that of a mesh of a known unit it is as large as the bodies that the weights know."""
    mesh = blob("ball")
    net = copier(data="humans")
    same = transfer_pose(mesh, person, weights=net, frame="identity", refine=False, **UPRIGHT).verts
    assert_near(same - standing_point(same), mesh[0] - standing_point(mesh[0]), 1e-4)
    other = transfer_pose(mesh, person, weights=net, refine=False, **UPRIGHT).verts
    factor = scale_to(float(_kinds.surface_area(*mesh)), float(_kinds.surface_area(*_kinds.rest_body("humans")))).factor
    assert_near(other - standing_point(other), factor * (mesh[0] - standing_point(mesh[0])), 1e-3)


def test_a_pose_mesh_of_the_other_kind_is_told(person):
    animals = load_animals()
    net = copier(data="humans", usual=WIDE)
    report = transfer_pose(person, (animals.template, animals.faces), weights=net, **UPRIGHT).report
    said = "these weights are for humans, but the pose mesh has the shape of animals: use weights of its kind"
    assert report.warnings == (said,)
    assert report.pose.scale.unit == "unknown"
    assert transfer_pose(person, person, weights=net, **UPRIGHT).report.warnings == ()


def test_the_kind_is_looked_at_once_and_where_it_counts(person, monkeypatch):
    looked = []

    def look(verts, _):
        looked.append(len(verts))
        return Likeness("humans", -1.0, 1.0)

    monkeypatch.setattr("meshkit.transfer._open.guess_kind", look)
    monkeypatch.setattr(choose, "pretrained_names", lambda: ["a"])
    monkeypatch.setattr(choose, "load_pretrained", lambda _: copier(name="a", data="humans", figures={"pmd": 1.0}))
    transfer_pose(person, person, **UPRIGHT)
    assert len(looked) == 2, "the identity, to choose by it and to check it, and the pose mesh"
    looked.clear()
    transfer_pose(person, person, weights=copier(), **UPRIGHT)
    assert not looked, "weights that do not say what they are for"


def test_doubt_of_size_and_axes_is_a_warning(person, monkeypatch):
    net = copier(data="humans", usual=WIDE)
    odd = (3 * person[0], person[1])
    (text,) = transfer_pose(odd, person, weights=net, identity_unit="m", **UPRIGHT).report.warnings
    assert text.startswith("identity: far from the size of the training bodies in the unit given, m: scaled by 0.3")
    for clear in (False, True):
        monkeypatch.setattr("meshkit.transfer._prepare.find_rotation", lambda *_, c=clear, **__: (torch.eye(3), c))
        report = transfer_pose(person, (person[0] + 0.1, person[1]), weights=net, identity_up="+z", pose_up="+z").report
        text = "pose: axes in doubt (up +z, facing -y): give them, up and facing, if they are wrong"
        assert (text in report.warnings) != clear
        assert ("all within" in str(report)) == clear


def test_auto_takes_the_best_weights_of_the_kind(person, monkeypatch):
    cards = {"a": ("humans", 3.0), "b": ("humans", 1.0), "c": ("animals", 0.5)}
    monkeypatch.setattr(choose, "pretrained_names", lambda: sorted(cards))
    monkeypatch.setattr(
        choose,
        "load_pretrained",
        lambda name, **_: copier(name=name, data=cards[name][0], figures={"pmd": cards[name][1]}),
    )
    net, why = choose.choose_weights("auto", lambda: open_mesh(person, "identity"))
    assert net.card["name"] == "b" and "shape is that of humans" in why
    animals = load_animals()
    animal = open_mesh((animals.template, animals.faces), "identity")
    net, *_ = choose.choose_weights("auto", lambda: animal)
    assert net.card["name"] == "c"
    del cards["c"]
    with pytest.raises(ValueError, match="no weights for animals"):
        choose.choose_weights("auto", lambda: animal)


def test_a_runs_folder_gives_weights(tmp_path):
    from safetensors.torch import save_file

    def unread():
        raise AssertionError("the identity mesh is only looked at to choose")

    config = GeneratorConfig(extractor_widths=(8, 16), k=4, widths=(16, 8))
    save_file(config.build().state_dict(), tmp_path / "model.safetensors")
    (tmp_path / "model.json").write_text('{"extractor_widths": [8, 16], "k": 4, "widths": [16, 8]}')
    assert choose.choose_weights(tmp_path, unread)[0].card == {}
    for text, facts in (
        ('{"data": "humans", "vertices": 2000}', {"data": "humans", "vertices": 2000, "name": tmp_path.name}),
        ('{"data": "animals", "vertices": null}', {"data": "animals", "name": tmp_path.name}),
        ('{"data": "my own"}', {}),
        ("{", {}),
    ):
        (tmp_path / "config.json").write_text(text)
        assert choose.choose_weights(str(tmp_path), unread)[0].card == facts


# Bad input


def test_unusable_meshes_and_options_are_refused(person, mover, tmp_path, monkeypatch):
    net = copier()
    with pytest.raises(ValueError, match="weights must be 'auto', the folder of a run, or shipped weights by their"):
        transfer_pose(person, mover, weights="nothing")
    with pytest.raises(ValueError, match="got 'corenet-human': did you mean corenet3d-humans"):
        transfer_pose(person, mover, weights="corenet-human")
    with pytest.raises(ValueError, match="frame must be"):
        PoseTransfer(person, weights=net, frame="world")
    with pytest.raises(ValueError, match="refine must be"):
        PoseTransfer(person, weights=net, refine=-1.0)
    with pytest.raises(ValueError, match="refine must be"):
        PoseTransfer(person, weights=net, refine=math.nan)
    with pytest.raises(ValueError, match="device cuda:99 cannot be used"):
        PoseTransfer(person, weights=net, device="cuda:99")
    with pytest.raises(ValueError, match=r"identity must be .* got \(ndarray, Tensor\); torch.as_tensor makes"):
        transfer_pose((person[0].numpy(), person[1]), person, weights=copier())
    with pytest.raises(ValueError, match=r"identity must be a path or a tuple \(verts, faces\)"):
        PoseTransfer(person[0], weights=net)
    with pytest.raises(MeshFileError, match="no such file"):
        PoseTransfer(tmp_path / "none.obj", weights=net)
    (tmp_path / "bad.obj").write_text("v 0 0 zero\n")
    with pytest.raises(MeshFileError, match=r"bad\.obj"):
        PoseTransfer(tmp_path / "bad.obj", weights=net)
    square = (torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(ValueError, match="pose: 4 vertices in its largest part; a body needs 64"):
        transfer_pose(person, square, weights=net, **UPRIGHT)
    nan = person[0].clone()
    nan[5] = math.nan
    with pytest.raises(ValueError, match="identity: 1 of 1000 vertices have NaN"):
        PoseTransfer((nan, person[1]), weights=net)
    with pytest.raises(ValueError, match="pose: up and facing are not clear"):
        transfer_pose(person, mover, weights=net, identity_up="+z", identity_facing="-y")
    with pytest.raises(ValueError, match="these weights have no matching"):
        PoseTransfer(person, weights=copier(data="humans"))
    nn.init.constant_(net.generator.scale, math.inf)
    with pytest.raises(ValueError, match="the network's result is not finite"):
        transfer_pose(person, mover, weights=net, **UPRIGHT)


# Sequences


@pytest.fixture(scope="module")
def moves() -> tuple[Tensor, Tensor]:
    body = load_humans(2000)
    return body(torch.tensor([50, 50, 50]), torch.tensor([500, 501, 502])), body.faces


def test_sequences_are_read_in_order(moves, tmp_path):
    verts, faces = moves
    np.savez(tmp_path / "m.npz", verts=verts.numpy(), faces=faces.numpy())
    folder = tmp_path / "poses"
    for number, frame in zip((2, 10, 100), verts, strict=True):
        save_mesh(folder / f"pose{number}.obj", frame, faces)
    (folder / "notes.txt").write_text("not a mesh")
    scene = trimesh.Scene()
    for number, frame in enumerate(verts):
        scene.add_geometry(trimesh.Trimesh(frame.numpy(), faces.numpy(), process=False), node_name=f"frame{number}")
    scene.export(tmp_path / "m.glb")
    for source in (tmp_path / "m.npz", folder, tmp_path / "m.glb"):
        read = [mesh if isinstance(mesh, tuple) else load_mesh(mesh) for mesh in read_sequence(source)]
        assert torch.equal(torch.stack([v for v, _ in read]), verts), source
        assert all(torch.equal(f, faces) for _, f in read)


def test_bad_sequences_are_refused(moves, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(MeshFileError, match="no mesh files in this folder"):
        read_sequence(tmp_path / "empty")
    with pytest.raises(MeshFileError, match="no such file or folder"):
        read_sequence(tmp_path / "none.npz")
    (tmp_path / "x.obj").write_text("")
    with pytest.raises(MeshFileError, match="poses come as a folder"):
        read_sequence(tmp_path / "x.obj")
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    (tmp_path / "bad.glb").write_bytes(b"glTF nothing")
    np.savez(tmp_path / "flat.npz", verts=moves[0][0].numpy(), faces=moves[1].numpy())
    np.savez(tmp_path / "other.npz", faces=moves[1].numpy(), vertices=moves[0].numpy())
    np.savez(tmp_path / "objects.npz", verts=np.array([{}]), faces=moves[1].numpy())
    for name, said in (("bad", "damaged or cut short"), ("other", "there is no verts"), ("objects", "holds objects")):
        with pytest.raises(MeshFileError, match=rf"not an \.npz file with arrays verts and faces \(.*{said}"):
            read_sequence(tmp_path / f"{name}.npz")
    with pytest.raises(MeshFileError, match="not a readable GLB file"):
        read_sequence(tmp_path / "bad.glb")
    with pytest.raises(MeshFileError, match=r"expected floating verts \(T, V, 3\)"):
        read_sequence(tmp_path / "flat.npz")


def test_small_files_of_many_poses_do_not_fill_the_memory(moves, tmp_path, monkeypatch):
    verts, faces = moves
    mesh = trimesh.Trimesh(verts[0].numpy(), faces.numpy(), process=False)
    scene = trimesh.Scene()
    for number in range(40):
        scene.add_geometry(mesh, node_name=f"{number}", geom_name="one")
    scene.export(tmp_path / "m.glb")
    np.savez_compressed(tmp_path / "m.npz", verts=np.zeros((50, 2000, 3), np.float32), faces=faces.numpy())
    (tmp_path / "claims.glb").write_bytes(_glb_that_claims(10**8))
    with pytest.raises(MeshFileError, match="an array of 100000000 elements cannot be in a file of"):
        read_sequence(tmp_path / "claims.glb")
    monkeypatch.setattr("meshkit.transfer.sequence._MAX_BYTES", 2**20)
    with pytest.raises(MeshFileError, match="its 40 meshes would take 5 MiB"):
        read_sequence(tmp_path / "m.glb")
    with pytest.raises(MeshFileError, match=r"bytes, more than the 1,048,576 allowed\)"):
        read_sequence(tmp_path / "m.npz")
    monkeypatch.setattr("meshkit.transfer.sequence._MAX_BYTES", 1000)
    with pytest.raises(MeshFileError, match="bytes, more than the 1,000 allowed"):
        read_sequence(tmp_path / "m.glb")


def _glb_that_claims(count: int) -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, "accessors": [{"count": count}]}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


@pytest.mark.parametrize("axes", [UPRIGHT, {"identity_up": "+z", "identity_facing": "-y", "pose_up": "+z"}])
def test_sequences_of_weights_without_a_matching(axes, person, moves):
    """The orientation is the first pose's, given; without it, what the first one says."""
    poses = [(v, moves[1]) for v in moves[0]]
    results = transfer_sequence(person, poses, weights=copier(data="humans"), **axes)
    if axes is UPRIGHT:
        assert len(list(results)) == 3
    else:
        with pytest.raises(ValueError, match="pose 0: these weights have no matching"):
            list(results)


def test_a_sequence_is_as_its_poses_one_by_one(person, moves):
    verts, faces = moves
    poses = [(v + torch.tensor([0.0, 0, float(t)]), faces) for t, v in enumerate(verts)]
    results = list(transfer_sequence(person, poses, weights=copier(), **UPRIGHT))
    assert len(results) == 3
    for result, (pose, _) in zip(results, poses, strict=True):
        expected = person[0] - standing_point(person[0]) + standing_point(pose)
        assert_near(result.verts, expected, 1e-4)
    # Later poses keep the first one's simplification: the simple vertices lie on their surface.
    simple = results[2].report.pose.simple
    assert len(simple.verts) == 1000
    assert float(torch.cdist(simple.verts, poses[2][0]).amin(1).max()) < 0.05


def test_the_roughness_of_the_identity_is_measured_once(person, moves, monkeypatch):
    sizes = []
    monkeypatch.setattr("meshkit.transfer._prepare.roughness", lambda verts, faces: sizes.append(verts) or 0.1)
    monkeypatch.setattr("meshkit.transfer.confidence.roughness", lambda *_: pytest.fail("measured again"))
    poses = [(v, moves[1]) for v in moves[0]]
    results = list(transfer_sequence(person, poses, weights=copier(), **UPRIGHT))
    assert len(sizes) == 4 and results[2].report.confidence.identity_roughness == 0.1


def test_the_kind_of_a_sequence_is_looked_at_once(person, moves, monkeypatch):
    looked = []
    monkeypatch.setattr(
        "meshkit.transfer._open.guess_kind",
        lambda verts, _: looked.append(len(verts)) or Likeness("animals", 1.0, 1.0),
    )
    poses = [(v, moves[1]) for v in moves[0]]
    results = list(transfer_sequence(person, poses, weights=copier(data="humans"), **UPRIGHT))
    assert len(looked) == 2  # the identity and the first pose
    assert all("pose mesh has the shape of animals" in result.report.warnings[1] for result in results)


@pytest.mark.parametrize(
    ("given", "count"), [({"pose_up": "+z"}, 3), ({"pose_facing": "-y"}, 3), ({}, 7), ({"pose_up": "-x"}, 3)]
)
def test_an_axis_that_was_given_holds_for_every_pose(given, count, person, moves, monkeypatch):
    net = copier(data="humans", usual=WIDE)
    pretend_matching(monkeypatch)
    asked = []

    def find(*_, candidates, **__):
        asked.append(len(candidates))
        return candidates[-1], True  # not the one before

    monkeypatch.setattr("meshkit.transfer._prepare.find_rotation", find)
    monkeypatch.setattr("meshkit.transfer.sequence.find_rotation", find)
    poses = [(v, moves[1]) for v in moves[0]]
    results = transfer_sequence(person, poses, weights=net, identity_up="+z", identity_facing="-y", **given)
    found = [result.report.pose.rotation for result in results]
    assert asked[1:] == [count, count] and not torch.equal(found[0], found[1])
    for rotation in found:
        assert given.get("pose_up") in (None, axis_name(rotation[2]))
        assert given.get("pose_facing") in (None, axis_name(-rotation[1]))


def test_a_later_pose_whose_axes_are_in_doubt_is_named(person, moves, monkeypatch):
    net = copier(data="humans", usual=WIDE)
    pretend_matching(monkeypatch)
    monkeypatch.setattr("meshkit.transfer._prepare.find_rotation", lambda *_, **__: (torch.eye(3), True))
    clear = iter((False, True))
    monkeypatch.setattr("meshkit.transfer.sequence.find_rotation", lambda *_, **__: (torch.eye(3), next(clear)))
    axes = {name: axis for name, axis in UPRIGHT.items() if name != "pose_facing"}
    results = transfer_sequence(person, [(v, moves[1]) for v in moves[0]], weights=net, **axes)
    said = "pose 1: axes in doubt (up +z, facing -y): give them, up and facing, if they are wrong"
    reports = [result.report for result in results]
    assert [report.warnings for report in reports] == [(), (said,), ()]
    assert ["in doubt" in report.pose.found for report in reports] == [False, True, False]


def test_doubt_about_the_first_poses_axes_is_not_said_of_later_ones(person, moves, monkeypatch):
    net = copier(data="humans", usual=WIDE)
    pretend_matching(monkeypatch)
    monkeypatch.setattr("meshkit.transfer._prepare.find_rotation", lambda *_, **__: (torch.eye(3), False))
    monkeypatch.setattr("meshkit.transfer.sequence.find_rotation", lambda *_, **__: (torch.eye(3), True))
    axes = {name: axis for name, axis in UPRIGHT.items() if name != "pose_facing"}
    results = transfer_sequence(person, [(v, moves[1]) for v in moves[0]], weights=net, **axes)
    assert [len(result.report.warnings) for result in results] == [1, 0, 0]


@pytest.mark.parametrize("quiet", [True, False])
def test_the_command_says_each_doubt_once(quiet, person, moves, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data="humans", usual=WIDE))
    save_mesh(tmp_path / "id.obj", 3 * person[0], person[1])
    np.savez(tmp_path / "moves.npz", verts=moves[0].numpy(), faces=moves[1].numpy())
    axes = ["--identity-up=+z", "--identity-facing=-y", "--pose-up=+z", "--pose-facing=-y", "--identity-unit=m"]
    words = [*axes, "--weights", "copy", "--no-picture", "--no-html", *(["--quiet"] if quiet else [])]
    command(tmp_path / "id.obj", tmp_path / "moves.npz", "-o", tmp_path / "out.npz", *words)
    said = "".join(capsys.readouterr())
    assert said.count("far from the size of the training bodies") == 1


@pytest.mark.parametrize("quiet", [True, False])
def test_a_doubt_with_other_numbers_is_said_once_and_of_its_own_mesh(
    quiet, person, moves, tmp_path, monkeypatch, capsys
):
    limits = {"identity_roughness": {"median": 0.0, "limit": 0.001}, "pose_roughness": {"median": 0.0, "limit": 0.001}}
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data="humans", usual=limits))
    identity = tmp_path / "id.obj"
    save_mesh(identity, 3 * person[0], person[1])
    for number, frame in enumerate(moves[0]):
        save_mesh(tmp_path / "poses" / f"{number}.obj", frame, moves[1])
    axes = [*(f"--{name.replace('_', '-')}={axis}" for name, axis in UPRIGHT.items()), "--identity-unit=m"]
    words = [*axes, "--weights", "copy", "--no-picture", "--no-html", *(["--quiet"] if quiet else [])]
    command(identity, tmp_path / "poses", "-o", tmp_path / "out.npz", *words)
    out, err = capsys.readouterr()
    for what in ("the pose mesh's surface is rough", "the identity mesh's surface is rough", "far from the size"):
        assert (out + err).count(what) == 1
    first = os.fspath(tmp_path / "poses" / "0.obj")
    if quiet:
        starts = (f"{identity}: far", f"{identity}: the identity mesh's surf", f"{first}: the pose mesh's surface is")
        assert all(line.startswith(f"unusual: {start}") for line, start in zip(err.splitlines(), starts, strict=True))
    results = list(transfer_sequence(identity, tmp_path / "poses", weights=copier(usual=limits), **UPRIGHT))
    assert len({result.report.confidence.pose_roughness for result in results}) == 3, "three numbers, one warning"


def test_a_doubt_that_begins_later_is_said_of_that_pose(person, moves, tmp_path, monkeypatch, capsys):
    smooth, rough = (Confidence(None, None, 0.1, None, None, 0.1, number) for number in (0.1, 0.3))
    numbers = iter((smooth, rough, replace(rough, pose_roughness=0.4)))
    monkeypatch.setattr("meshkit.transfer.transfer.measure_confidence", lambda *_, **__: next(numbers))
    monkeypatch.setattr(
        choose, "load_weights", lambda *_: copier(usual={"pose_roughness": {"median": 0.1, "limit": 0.2}})
    )
    save_mesh(tmp_path / "id.obj", *person)
    for number, frame in enumerate(moves[0]):
        save_mesh(tmp_path / "poses" / f"{number}.obj", frame, moves[1])
    axes = [f"--{name.replace('_', '-')}={axis}" for name, axis in UPRIGHT.items()]
    words = [*axes, "--weights", "copy", "--no-picture", "--no-html"]
    command(tmp_path / "id.obj", tmp_path / "poses", "-o", tmp_path / "out.npz", *words)
    (said,) = [line for line in capsys.readouterr().out.splitlines() if "is rough" in line]
    assert said.startswith(f"unusual: {tmp_path / 'poses' / '1.obj'}: the pose mesh's surface is rough: 0.300 (")


def test_the_page_of_a_sequence_has_the_headline_of_what_the_first_pose_is_doubted_for(
    person, moves, tmp_path, monkeypatch
):
    notes = []
    monkeypatch.setattr("meshkit.transfer.output.save_html", lambda *_, **options: notes.extend(options["notes"]))
    giants = [(3 * v, moves[1]) for v in moves[0]]
    net = copier(data="humans", usual=WIDE)
    *_, last = transfer_sequence(person, giants, weights=net, pose_unit="m", **UPRIGHT)
    save_page(tmp_path / "x.html", last)
    assert notes[2] == "pose: far from the size of the training bodies in the unit given, m"
    assert last.report.warnings[0].startswith("pose 2: far from the size"), "the doubt of the pose that it is said of"


def test_what_the_reader_says_of_the_first_pose_is_kept(person, moves, tmp_path):
    (a, b, c), *others = (moves[1] + 1).tolist()
    beside = next(face for face in others if {a, b} < set(face))
    (d,) = set(beside) - {a, b}
    others[others.index(beside)] = [a, d, b, c]  # one quad instead of two triangles
    lines = [f"v {x} {y} {z}" for x, y, z in moves[0][0].tolist()] + [f"f {' '.join(map(str, f))}" for f in others]
    (tmp_path / "p0.obj").write_text("\n".join(lines))
    alone = transfer_pose(person, tmp_path / "p0.obj", weights=copier(), **UPRIGHT).report.pose.notes
    (result,) = transfer_sequence(person, tmp_path, weights=copier(), **UPRIGHT)
    assert "split into triangles" in alone[0] and result.report.pose.notes == alone


@pytest.fixture
def poses_some_bad(moves, tmp_path) -> Path:
    """A folder of six poses: 1 is text, 2 has a vertex that is none, 4 is flat: it follows the faces of 0."""
    verts, faces = moves
    folder = tmp_path / "poses"
    for number, place in ((0, 0), (2, 1), (3, 1), (5, 2)):
        save_mesh(folder / f"p_{number}.obj", verts[place], faces)
    (folder / "p_1.obj").write_text("f 1 2\n")
    text = (folder / "p_2.obj").read_text().splitlines()
    (folder / "p_2.obj").write_text("\n".join(["v nan 0 0", *text[1:]]))
    (folder / "p_4.obj").write_text(re.sub("v .*", "v 1 1 1", (folder / "p_0.obj").read_text()))
    return folder


def test_all_bad_poses_are_listed_before_the_first_transfer(person, poses_some_bad, monkeypatch):
    made = []
    monkeypatch.setattr(PoseTransfer, "apply", lambda *_, **__: made.append(1))
    with pytest.raises(UnusablePosesError, match=r"3 of 6 poses cannot be used.*skip_bad") as caught:
        next(transfer_sequence(person, poses_some_bad, weights=copier(), **UPRIGHT))
    assert not made and len(caught.value.reasons) == 3
    names = [str(poses_some_bad / f"p_{number}.obj") for number in (1, 2, 4)]
    assert all(reason.startswith(name) for reason, name in zip(caught.value.reasons, names, strict=True))
    assert "no surface area" in caught.value.reasons[2]
    assert str(caught.value).splitlines()[1:] == [f"  {reason}" for reason in caught.value.reasons]


def test_bad_poses_are_left_out_and_told(person, moves, poses_some_bad):
    options = {"weights": copier(), "skip_bad": True, **UPRIGHT}
    with pytest.warns(UserWarning, match="3 of 6 poses are left out") as caught:
        results = list(transfer_sequence(person, poses_some_bad, **options))
    assert [Path(result.report.pose.name).name for result in results] == ["p_0.obj", "p_3.obj", "p_5.obj"]
    assert len(caught) == 1 and all(f"p_{number}.obj" in str(caught[0].message) for number in (1, 2, 4))
    with pytest.warns(UserWarning, match=r"a pose is left out: .*p_\d\.obj") as caught:  # as they come
        later = list(transfer_sequence(person, iter(read_sequence(poses_some_bad)), **options))
    assert len(caught) == 3
    assert_near(torch.stack([r.verts for r in later]), torch.stack([r.verts for r in results]), 1e-6)
    for number in (0, 3, 5):
        (poses_some_bad / f"p_{number}.obj").unlink()
    with pytest.raises(UnusablePosesError, match="3 of 3 poses cannot be used; there is nothing to transfer"):
        next(transfer_sequence(person, poses_some_bad, **options))


def test_checking_poses_keeps_none_of_them(person, moves, tmp_path, monkeypatch):
    alive: list[weakref.ref] = []

    def load(path):
        gc.collect()
        assert sum(ref() is not None for ref in alive) <= 1, "the one before, until it is replaced"
        verts = moves[0][int(path.stem)].clone()
        alive.append(weakref.ref(verts))
        return verts, moves[1]

    monkeypatch.setattr("meshkit.transfer._open.load_mesh", load)
    check = sequence._Check()
    assert [check(number, tmp_path / f"{number % 3}.obj") for number in range(6)] == [None] * 6


def test_a_broken_pose_in_a_sequence_is_named(person, moves):
    verts = moves[0].clone()
    verts[1, 7] = math.nan
    poses = [(v, moves[1]) for v in verts]
    with pytest.raises(ValueError, match="pose 1: vertices are NaN or infinite"):
        list(transfer_sequence(person, poses, weights=copier(), **UPRIGHT))


# Command


def command(*words: object) -> None:
    main([str(word) for word in words])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.obj", "id.obj"], "none.obj: no such file"),
        (["id.obj", "none.obj"], "none.obj: no such file"),
        (["id.obj", "id.obj", "-o", "x.txt"], "the result is written as .obj"),
        (["id.obj", "id.obj", "-o", "x.npz"], "the result is written as .obj"),
        (["id.obj", "id.obj", "-o", "id.obj"], "would overwrite an input"),
        (["id.obj", "id.obj", "-o", "out.obj", "--report", "id.obj"], "would overwrite an input"),
        (["folder", "id.obj"], "folder: a folder; the identity is one mesh"),
        (["id.obj", "id.obj", "--refine", "-1"], "--refine must be a positive weight, got -1"),
        (["id.obj", "id.obj", "--refine", "1", "--no-refine"], "exclude each other"),
        (["id.obj", "id.obj", "--threads", "-1"], "--threads cannot be negative, got -1"),
        (["id.obj", "id.obj", "--pose-up", "+z", "--pose-facing", "-z"], "--pose-facing -z must be at right angles"),
        (["id.obj", "id.obj", "--weights", "none"], "weights must be 'auto'"),
        (["bad.obj", "id.obj"], "bad.obj: not a readable OBJ mesh"),
    ],
)
def test_mistakes_are_one_line_and_status_2(words, message, person, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_mesh("id.obj", *person)
    Path("bad.obj").write_text("f 1 2\n")
    Path("folder").mkdir()
    with pytest.raises(SystemExit) as caught:
        command(*words)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error


@pytest.mark.parametrize(
    "words",
    [
        ["id.obj", "poses", "-o", "poses/pose.obj"],
        ["id.obj", "poses", "-o", "elsewhere/../poses/new.obj"],
        ["out_pose_0001.obj", "poses", "-o", "out.obj"],
        ["id.obj", "poses", "-o", "out.npz", "--report", "poses/pose_0000.obj"],
        ["id.obj", "moves_0000.glb", "-o", "moves.glb"],
    ],
)
def test_many_results_never_overwrite_an_input(words, person, moves, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    Path("elsewhere").mkdir()
    for name in ("id.obj", "out_pose_0001.obj"):
        save_mesh(name, *person)
    scene = trimesh.Scene()
    for number, frame in enumerate(moves[0]):
        save_mesh(f"poses/pose_{number:04d}.obj", frame, moves[1])
        scene.add_geometry(trimesh.Trimesh(frame.numpy(), moves[1].numpy(), process=False), node_name=f"f{number}")
    scene.export("moves_0000.glb")
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))}
    axes = ["--identity-up=+z", "--identity-facing=-y", "--pose-up=+z", "--pose-facing=-y", "--weights", "copy"]
    with pytest.raises(SystemExit) as caught:
        command(*words, *axes)
    error = capsys.readouterr().err
    assert caught.value.code == 2 and error.count("\n") == 1 and "overwrite" in error
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))} == before


QUIET = ["--no-picture", "--no-html", "--quiet"]
AXES = [f"--{name.replace('_', '-')}={axis}" for name, axis in UPRIGHT.items()]


def test_results_are_named_after_the_files_of_their_poses(person, moves, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    save_mesh(tmp_path / "id.obj", *person)
    sources = ("jump.obj", "p10.obj", "p9.obj", "p9.ply")
    for name, frame in zip(sources, moves[0][[0, 1, 2, 2]], strict=True):
        save_mesh(tmp_path / "poses" / name, frame, moves[1])
    words = [tmp_path / "id.obj", tmp_path / "poses", *AXES, "--weights", "copy", *QUIET]
    command(*words, "-o", tmp_path / "r" / "out.obj", "--report", tmp_path / "report.json")
    named = ("out_jump.obj", "out_p9_obj.obj", "out_p9_ply.obj", "out_p10.obj")  # in the order of the poses
    assert sorted(os.listdir(tmp_path / "r")) == sorted(named)
    reports = json.loads((tmp_path / "report.json").read_text())
    assert [Path(report["file"]).name for report in reports] == list(named)
    assert reports[0]["numbers"]["edge_change"] == pytest.approx(0, abs=1e-5)
    assert (reports[3]["pose"]["up"], reports[3]["pose"]["vertices"], reports[3]["doubts"]) == ("+z", 2000, [])
    command(*words, "-o", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as archive:
        assert archive["names"].tolist() == ["jump.obj", "p9.obj", "p9.ply", "p10.obj"]
        last = torch.from_numpy(archive["verts"][3])
    assert torch.equal(load_mesh(tmp_path / "r" / "out_p10.obj")[0], last)
    save_mesh(tmp_path / "poses" / "p9_obj.stl", moves[0][0], moves[1])
    with pytest.raises(SystemExit):
        command(*words, "-o", tmp_path / "r" / "out.obj")
    assert "would have one name, p9_obj: rename one of them" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".obj", ".npz"])
def test_the_command_leaves_out_bad_poses(suffix, person, poses_some_bad, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    save_mesh(tmp_path / "id.obj", *person)
    out = tmp_path / "r" / f"out{suffix}"
    words = [tmp_path / "id.obj", poses_some_bad, *AXES, "--weights", "copy", *QUIET, "-o", out]
    with pytest.raises(SystemExit):
        command(*words)
    error = capsys.readouterr().err
    assert error.startswith("error: 3 of 6 poses cannot be used;") and "--skip-bad" in error
    assert [Path(line.split(":")[0]).name for line in error.splitlines()[1:]] == ["p_1.obj", "p_2.obj", "p_4.obj"]
    assert not out.parent.exists()
    command(*words, "--skip-bad", "--report", tmp_path / "report.json")
    reports = json.loads((tmp_path / "report.json").read_text())
    names = [Path(report["pose"]["name"]).name for report in reports if report.get("left_out")]
    assert len(reports) == 6 and names == ["p_1.obj", "p_2.obj", "p_4.obj"]
    error = capsys.readouterr().err
    assert error.startswith("warning: 3 of 6 poses are left out:\n  ") and len(error.splitlines()) == 4
    if suffix == ".obj":
        assert sorted(os.listdir(out.parent)) == ["out_p_0.obj", "out_p_3.obj", "out_p_5.obj"]
    else:
        with np.load(out) as archive:
            assert archive["names"].tolist() == ["p_0.obj", "p_3.obj", "p_5.obj"] and len(archive["verts"]) == 3


@pytest.mark.parametrize(
    ("suffix", "kept"), [(".obj", "2 files, {}_a.obj to {}_b.obj"), (".npz", "1 file, {}_partial.npz")]
)
@pytest.mark.parametrize("error", [ValueError("odd"), KeyboardInterrupt()])
def test_what_is_kept_after_an_error_is_told(suffix, kept, error, person, moves, tmp_path, monkeypatch, capsys):
    apply, count = PoseTransfer.apply, itertools.count()
    monkeypatch.setattr(PoseTransfer, "apply", lambda *a, **o: apply(*a, **o) if next(count) < 2 else _raise(error))
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    save_mesh(tmp_path / "id.obj", *person)
    for name, frame in zip("abc", moves[0], strict=True):
        save_mesh(tmp_path / "poses" / f"{name}.obj", frame, moves[1])
    out = tmp_path / "r" / f"out{suffix}"
    with pytest.raises(SystemExit) as caught:
        command(tmp_path / "id.obj", tmp_path / "poses", *AXES, "--weights", "copy", *QUIET, "-o", out)
    assert caught.value.code == (2 if isinstance(error, ValueError) else 130)
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"error: {'odd' if isinstance(error, ValueError) else 'interrupted'}"
    assert second == f"kept: {kept.replace('{}', str(out.with_suffix('')))}"
    assert len(os.listdir(out.parent)) == (2 if suffix == ".obj" else 1)
    if suffix == ".npz":
        with np.load(tmp_path / "r" / "out_partial.npz") as archive:
            assert archive["verts"].shape == (2, 1000, 3)


def test_mistakes_are_found_before_pytorch_is_imported(tmp_path):
    code = (
        "import sys\nfrom meshkit._transfer_command import main\n"
        "try: main(sys.argv[1:])\nexcept SystemExit as end: sys.exit(end.code + ('torch' in sys.modules))"
    )
    for words in (["none.obj", "x.obj"], [tmp_path, tmp_path, "--refine", "-1"], ["a", "b", "--frame", "c"]):
        done = subprocess.run([sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True)
        assert done.returncode == 2 and done.stderr.startswith("error: "), done.stderr
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and all(name in done.stdout for name in pretrained_names()), done.stdout


def test_the_commands_units_are_those_of_the_package():
    assert tuple(UNITS) == front.UNITS


def test_a_device_without_memory_is_one_line(person, tmp_path, monkeypatch, capsys):
    def fail(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 8 GiB")

    monkeypatch.setattr("meshkit.transfer.command.transfer_pose", fail)
    save_mesh(tmp_path / "id.obj", *person)
    with pytest.raises(SystemExit) as caught:
        command(tmp_path / "id.obj", tmp_path / "id.obj", "-o", tmp_path / "out.obj")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "error: CUDA out of memory. Tried to allocate 8 GiB (on device cpu)\n"


def test_any_kind_of_value_error_gets_the_meshs_name():
    with pytest.raises(ValueError, match="pose: 'utf-8' codec can't decode"):
        named("pose", lambda: b"\xff".decode())
    with pytest.raises(MeshFileError, match=r"pose: m\.obj: damaged"):
        named("pose", lambda: _raise(MeshFileError("m.obj: damaged")))


def _raise(error: BaseException) -> None:
    raise error


def test_an_axis_with_a_minus_may_stand_alone():
    words = ["a.obj", "b.obj", "--pose-facing", "-y", "--identity-up", "-z", "--pose-up=+x"]
    args = parser().parse_args(words)
    assert (args.pose_facing, args.identity_up, args.pose_up) == ("-y", "-z", "+x")
    with pytest.raises(SystemExit):
        parser().parse_args([*words, "-y"])
    args = parser().parse_args(["a.obj", "b.obj", "--pose-faci", "-y", "--identity-up", "-z", "-o", "c.obj"])
    assert (args.pose_facing, args.identity_up, args.out) == ("-y", "-z", Path("c.obj"))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--pose-up y", "argument --pose-up: takes +x, -x, +y, -y, +z or -z, got 'y': did you mean +y?"),
        ("--pose-up -Y", "argument --pose-up: takes +x, -x, +y, -y, +z or -z, got '-Y': did you mean -y?"),
        ("--pose-up up", "argument --pose-up: takes +x, -x, +y, -y, +z or -z, got 'up'"),
        ("--pose-facing -o b.obj", "argument --pose-facing: expected one argument"),
        ("--pose -y", "ambiguous option: --pose could match --pose-up, --pose-facing, --pose-unit"),
        (
            "--identity-unit centimetre",
            "argument --identity-unit: takes m, cm, mm, in or ft, got 'centimetre': did you mean cm?",
        ),
        ("--pose-unit km", "argument --pose-unit: takes m, cm, mm, in or ft, got 'km'"),
        ("--pose-unit Feet", "argument --pose-unit: takes m, cm, mm, in or ft, got 'Feet': did you mean ft?"),
        ("--pose-unit Inch", "argument --pose-unit: takes m, cm, mm, in or ft, got 'Inch': did you mean in?"),
        ("--frame identiy", "argument --frame: takes pose or identity, got 'identiy': did you mean identity?"),
    ],
)
def test_a_wrong_choice_is_told_with_the_nearest_and_all(line, said, capsys):
    with pytest.raises(SystemExit) as caught:
        parser().parse_args(["a.obj", "b.obj", *line.split()])
    assert caught.value.code == 2
    assert capsys.readouterr().err == f"error: {said}; --help lists the options\n"


def test_the_nearest_name_is_the_first_of_equals():
    assert nearest("y", ["+y", "-y"]) == "+y" and nearest("y", ["-y", "+y"]) == "-y"
    assert nearest("XDUALNET_human", ["xdualnet-animals", "xdualnet-humans"]) == "xdualnet-humans"
    assert nearest("zebra", ["+y", "humans"]) is None and nearest("a", []) is None
    assert did_you_mean("zebra", ["humans"]) == "" and did_you_mean("human", ["humans"]) == ": did you mean humans?"


def test_reports_say_how_good_the_weights_are(person, mover):
    figures = {"pmd": 9.17, "pmd_copy_identity": 20.4}
    text = str(transfer_pose(person, mover, weights=copier(usual=WIDE, figures=figures), **UPRIGHT).report)
    assert "PMD on unseen test pairs is 9.2e-3, where leaving the identity as it is has 20.4e-3; they are poor" in text
    good = copier(usual=WIDE, figures={"pmd": 1.1, "pmd_copy_identity": 55.3})
    text = str(transfer_pose(person, mover, weights=good, **UPRIGHT).report)
    assert "is 1.1e-3" in text and "poor" not in text
    assert "PMD" not in str(transfer_pose(person, mover, weights=copier(usual=WIDE), **UPRIGHT).report)


def test_a_misspelt_option_is_told_last_with_the_nearest(capsys):
    with pytest.raises(SystemExit):
        command("id.obj", "id.obj", "--idenity-up", "+z")
    assert "did you mean --identity-up?" in capsys.readouterr().err.splitlines()[-1]


def test_the_report_names_the_results_frame(person, mover):
    pose = (100 * mover[0], mover[1])
    for frame, said in (("pose", "unit (cm) of the pose mesh"), ("identity", "unit (m) of the identity mesh")):
        result = transfer_pose(person, pose, weights=copier(data="humans"), frame=frame, **UPRIGHT)
        assert f"in the axes and {said}, up +z" in str(result.report)


def test_animals_are_not_said_to_be_in_metres():
    scale = find_scale(1.0, 1.0, None, among=("m",))
    assert str(scale).startswith("m (guessed") and "m (" not in str(replace(scale, metric=False))


def test_the_command_writes_mesh_picture_and_page(person, mover, tmp_path, monkeypatch, capsys):
    from PIL import Image

    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    save_mesh(tmp_path / "id.ply", *person)
    save_mesh(tmp_path / "pose.obj", *mover)
    axes = ["--identity-up=+z", "--identity-facing=-y", "--pose-up=+z", "--pose-facing=-y", "--weights", "copy"]
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    command(tmp_path / "id.ply", tmp_path / "pose.obj", "-o", tmp_path / "r" / "out.obj", "--threads", "3", *axes)
    assert threads == [3]
    verts, faces = load_mesh(tmp_path / "r" / "out.obj")
    assert_near(verts, person[0] - standing_point(person[0]) + standing_point(mover[0]), 1e-4)
    assert torch.equal(faces, person[1])
    assert "result" in (tmp_path / "r" / "out.html").read_text()
    assert Image.open(tmp_path / "r" / "out.png").width > 1200
    assert "out.obj: 1000 vertices" in capsys.readouterr().out


def test_the_command_takes_sequences(person, moves, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(choose, "load_weights", lambda *_: copier(data=None))
    save_mesh(tmp_path / "id.obj", *person)
    np.savez(tmp_path / "moves.npz", verts=moves[0].numpy(), faces=moves[1].numpy())
    axes = ["--identity-up=+z", "--identity-facing=-y", "--pose-up=+z", "--pose-facing=-y", "--weights", "copy"]
    quick = [*axes, "--no-picture", "--no-html", "--quiet"]
    command(tmp_path / "id.obj", tmp_path / "moves.npz", "-o", tmp_path / "out.npz", *quick)
    command(tmp_path / "id.obj", tmp_path / "moves.npz", "-o", tmp_path / "out.obj", *quick)
    with np.load(tmp_path / "out.npz") as archive:
        written = torch.from_numpy(archive["verts"])
        assert np.array_equal(archive["faces"], person[1].numpy())
    for number in range(3):
        assert torch.equal(load_mesh(tmp_path / f"out_{number:04d}.obj")[0], written[number])
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("count", "said"), [(0, ""), (1, "1 warning"), (2, "2 warnings")])
@pytest.mark.parametrize("saved", [None, "r/numbers.json"])
def test_the_caption_counts_the_warnings(count, said, saved, person, tmp_path, monkeypatch):
    from PIL import Image

    seen = []

    def sheet(rows, *, captions, **_):
        seen.extend(captions)
        return Image.new("RGB", (2, 2))

    monkeypatch.setattr("meshkit.transfer.output.contact_sheet", sheet)
    result = transfer_pose(person, person, weights=copier(), **UPRIGHT)
    report = replace(result.report, doubts=(Doubt("", "odd"),) * count)
    save_picture(tmp_path / "x.png", [replace(result, report=report)], size=20, report=saved)
    assert seen[0][2] == (f"{said}: see numbers.json" if said and saved else said)


def test_the_page_has_the_headlines_of_the_warnings(person, mover, tmp_path, monkeypatch):
    notes = []
    monkeypatch.setattr("meshkit.transfer.output.save_html", lambda *_, **options: notes.extend(options["notes"]))
    result = transfer_pose(person, mover, weights=copier(), **UPRIGHT)
    numbers = Confidence(0.9, 0.1, 0.1, None, None, 0.2, 0.3)
    limits = {name: {"median": 0.1, "limit": 0.15} for name in ("match_spread", "mutual_share", "pose_roughness")}
    doubts = [Doubt("pose", "axes in doubt (up +z, facing -y): give them, up and facing, if they are wrong")]
    doubts += [Doubt("pose" if "pose mesh's" in text else "", text) for text in numbers.warnings(limits)]
    save_page(tmp_path / "x.html", replace(result, report=replace(result.report, doubts=doubts)))
    assert notes[2] == (
        "pose: axes in doubt; the network is unsure which places of the two meshes correspond, so limbs may go astray; "
        "few vertices of the two meshes are each other's best match; the pose mesh's surface is rough"
    )


def test_one_hole_is_a_hole(person, mover):
    verts, faces = person
    report = transfer_pose((verts, faces[1:]), mover, weights=copier(), **UPRIGHT).report
    assert "1 hole (3 boundary edges)" in str(report) and "the surface is open (1 hole, longest loop 0." in str(report)
    many = transfer_pose((verts, faces[1:-1]), mover, weights=copier(), **UPRIGHT).report
    assert "2 holes (6 boundary edges)" in str(many)


def without(kind: str, joint: int, who: int = 0) -> Mesh:
    """A shipped body without what hangs on a joint."""
    body, split = load_shipped(kind)
    cut, parents = {joint}, body.parents.tolist()
    for child in range(joint, len(parents)):
        cut |= {child} if parents[child] in cut else set()
    gone = body.weights[:, sorted(cut)].sum(1) > 0.5
    place = split.test_identities[who : who + 1], split.test_poses[:1]
    return body(*place)[0], body.faces[~gone[body.faces].any(1)]


def test_openings_are_measured():
    ring = trimesh.creation.cylinder(1.0, 2.0, sections=64)
    lids = np.abs(ring.face_normals[:, 2]) > 0.5
    tube = torch.tensor(ring.vertices).float(), torch.tensor(ring.faces[~lids])
    around = 64 * 2 * math.sin(math.pi / 64)
    loops, area = boundary_loops(*tube), 64 * math.sin(math.tau / 64) / 2
    assert_near(loops.length, torch.tensor([around, around]).double(), 1e-5)
    assert_near(loops.width, torch.tensor([area, area]).mul(4 * math.pi).sqrt().double(), 1e-5)
    assert_near(loops.facing, torch.zeros(2).double(), 1e-5)
    found = find_openings(*tube)
    assert found.loops == 2 and found.longest == pytest.approx(around / math.sqrt(2 * around), rel=1e-5)
    assert found.cut == pytest.approx(float(loops.width[0]) / math.sqrt(2 * around), rel=1e-5)
    assert "2 boundary loops, one as wide as a cut, 1.77 times" in found.doubt
    assert find_openings(10 * tube[0], tube[1]).longest == pytest.approx(found.longest, rel=1e-5)
    closed = find_openings(torch.tensor(ring.vertices), torch.tensor(ring.faces))
    assert closed == (0, 0.0, 0.0) and closed.doubt == ""


def sheet(count: int) -> Mesh:
    """A square of (count - 1) ** 2 squares."""
    grid = torch.arange(count * count).reshape(count, count)
    a, b, c, d = (t.flatten() for t in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    verts = torch.stack([grid // count, grid % count, 0 * grid], 2).reshape(-1, 3).float()
    return verts, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])


def test_a_hole_and_a_sheet_face_otherwise_than_a_cut():
    verts, faces = sheet(13)
    assert_near(boundary_loops(verts, faces).facing, -torch.ones(1).double(), 1e-6)
    inside = (verts[faces][..., :2].mean(1) - 6).abs().amax(1) < 1  # four squares in the middle
    for turned in (faces, faces.flip(1)):
        loops = boundary_loops(verts, turned[~inside])
        assert_near(loops.facing, torch.tensor([-1.0, 1.0]).double(), 1e-6)
        assert_near(loops.length, torch.tensor([48.0, 8.0]).double(), 1e-6)
        assert_near(loops.width, torch.tensor([144.0, 4.0]).mul(4 * math.pi).sqrt().double(), 1e-5)
    # A jagged edge is longer, and no wider: the corner of every other square of the rim is gone.
    jagged = torch.cat([faces[:144], faces[144:][verts[faces[144:]][..., 1].amax(1) < 12], faces[-1:]])
    smooth, rough = boundary_loops(verts, faces), boundary_loops(verts, jagged)
    assert rough.length[0] > 1.05 * smooth.length[0] and rough.width[0] < smooth.width[0]


@pytest.mark.parametrize(("radius", "told"), [(0.04, False), (0.1, True)])
def test_a_hole_in_the_back_is_no_cut_until_it_is_wide(radius, told):
    body = load_humans(6890)
    verts = body.template
    back = torch.tensor([0.0, verts[:, 1].max(), float(verts[:, 2].quantile(0.7))])
    middle = verts[((verts - back) ** 2).sum(1).argmin()]
    gone = (verts - middle).norm(dim=1) < radius
    found = find_openings(verts, body.faces[~gone[body.faces].any(1)])
    assert found.loops == 1 and found.longest > 0.1 and bool(found.cut) == told


def test_a_wrong_unit_changes_neither_kind_nor_roughness_nor_openings(person):
    """So the warnings about these have no reason to speak of units."""
    mesh = without("humans", 24)
    found = []
    for factor, unit in ((1.0, None), (1.0, "cm"), (1.0, "ft"), (1000.0, "m"), (0.0254, "in")):
        options = {"weights": copier(data="humans", usual=WIDE), "pose_unit": unit, **UPRIGHT}
        report = transfer_pose(person, (factor * mesh[0], mesh[1]), **options).report
        assert any("far from the size" in text for text in report.warnings) == (unit is not None)
        pose = report.pose
        found.append([pose.likeness.score, pose.likeness.distance, pose.roughness, pose.openings.longest])
    assert_near(torch.tensor(found), torch.tensor(found[:1]).expand(5, 4), 1e-3)


@pytest.mark.parametrize(
    ("kind", "joint"), [("humans", 24), ("humans", 5), ("humans", 71), ("animals", 14), ("animals", 29)]
)
def test_what_is_cut_off_is_noticed(kind, joint):
    """A hand, a foot, the head; a fore paw and a hind foot."""
    for who in (0, 1):
        assert "give the whole body" in find_openings(*without(kind, joint, who)).doubt
    body = load_shipped(kind)[0]
    assert find_openings(body.template, body.faces) == (0, 0.0, 0.0)


def test_an_open_mesh_is_in_doubt(mover):
    """Whatever its kind; a hole of one face is not, nor are seams of the file, which are welded."""
    verts, faces = without("humans", 71)
    report = transfer_pose((verts, faces), mover, weights=copier(data="humans", usual=WIDE), **UPRIGHT).report
    (said,) = [text for text in report.warnings if "open" in text]
    assert said.startswith("the identity mesh is open: 1 boundary loop, one as wide as a cut, 0.")
    assert report.as_dict()["identity"]["openings"]["loops"] == 1
    body = load_humans()
    net = copier(data="humans", usual=WIDE)
    soup = body.template[body.faces].reshape(-1, 3)
    seams = soup, torch.arange(len(soup)).reshape(-1, 3)
    for mesh, is_open in (((body.template, body.faces[1:]), True), (seams, False)):
        report = transfer_pose(mesh, mover, weights=net, **UPRIGHT).report
        assert report.warnings == () and ("the surface is open" in str(report)) == is_open


def test_no_results_are_no_picture(tmp_path):
    with pytest.raises(ValueError, match="no results to draw"):
        save_picture(tmp_path / "x.png", [])


def test_the_recipe_is_the_command(monkeypatch, capsys):
    recipe = Path(__file__).parents[1] / "recipes" / "transfer.py"
    monkeypatch.setattr(sys, "argv", ["transfer.py", "--help"])
    with pytest.raises(SystemExit) as caught:
        exec(compile(recipe.read_text(), recipe, "exec"), {"__name__": "__main__"})
    assert caught.value.code == 0 and "--pose-facing" in capsys.readouterr().out


# The shipped weights on meshes of other origin


def with_hole(mesh: Mesh) -> Mesh:
    """Cut a hole of 8 cm into the back."""
    verts, faces = mesh
    near = (verts - verts[verts[:, 1].argmax()]).norm(dim=1) < 0.08
    return verts, faces[~near[faces].any(1)]


def with_eye(mesh: Mesh) -> Mesh:
    """Add a ball inside the head, at the end of the vertices."""
    eye = trimesh.creation.icosphere(1, radius=0.02)
    place = mesh[0][mesh[0][:, 2].argmax()] - torch.tensor([0.0, 0, 0.1])
    return torch.cat([mesh[0], torch.tensor(eye.vertices).float() + place]), torch.cat(
        [mesh[1], torch.tensor(eye.faces).long() + len(mesh[0])]
    )


CASES = {
    "3445 vertices": lambda mesh: mesh,
    "y up, centimetres": lambda mesh: (100 * y_up(mesh[0]), mesh[1]),
    "turned by 90 degrees": lambda mesh: (mesh[0][:, [1, 0, 2]] * torch.tensor([-1.0, 1, 1]), mesh[1]),
    "a hole": with_hole,
    "an eye": with_eye,
}


@pytest.fixture(scope="module")
def fine_transfer():
    """An unseen person of 6890 vertices, ready to take poses with the shipped weights."""
    split = load_shipped("humans")[1]
    a, p, b, q = split.test_pairs[2].tolist()
    transfer = PoseTransfer(body_of(6890, a, p), weights=WEIGHTS)
    return transfer, body_of(3445, b, q), body_of(6890, a, q)[0]


@pytest.mark.skipif(WEIGHTS not in pretrained_names(), reason="this checkout lacks the weights")
@pytest.mark.parametrize("case", CASES)
def test_pose_meshes_of_any_origin(case, fine_transfer):
    """The result is near the truth, in axes and unit of the pose mesh; a wrong guess of the axes is in doubt."""
    transfer, pose, truth = fine_transfer
    change = CASES[case]
    result = transfer(change(pose))
    if case == "turned by 90 degrees" and axis_name(-result.report.pose.rotation[1]) != "+x":
        assert "in doubt" in str(result.report)
        result = transfer(change(pose), pose_facing="+x")
    posed, expected = result.verts, change((truth, transfer.identity.faces))[0][: len(truth)]
    metre = result.report.pose.scale.metres
    assert metre == (0.01 if case == "y up, centimetres" else 1.0)
    assert 1e3 * float(pmd(metre * posed[None], center(metre * expected[None]))[0]) < BOUND


@pytest.mark.skipif(WEIGHTS not in pretrained_names(), reason="this checkout lacks the weights")
def test_strangers_are_reported(fine_transfer):
    transfer, pose, _ = fine_transfer
    assert transfer(pose).report.warnings == ()
    animals = load_animals()
    ball = trimesh.creation.icosphere(4)
    points = torch.tensor(ball.vertices).float()
    bumps = (1 + 0.3 * torch.sin(5 * points).prod(1, keepdim=True)) * points
    noise = 0.02 * torch.randn(pose[0].shape, generator=torch.Generator().manual_seed(0))
    upright = {"pose_up": "+z", "pose_facing": "-y"}
    assert "the shape of animals" in transfer((animals.template, animals.faces), **upright).report.warnings[0]
    for blob in (points, bumps):
        warnings = transfer((blob, torch.tensor(ball.faces)), **upright, pose_unit="m").report.warnings
        assert sum("99 of 100" in text for text in warnings) >= 3, warnings
    rough = transfer((pose[0] + noise, pose[1]), **upright).report.warnings
    assert any("the pose mesh's surface is rough" in text for text in rough), rough


@pytest.mark.skipif(WEIGHTS not in pretrained_names(), reason="this checkout lacks the weights")
def test_wrong_axes_are_noticed_where_they_were_given(fine_transfer):
    transfer, pose, _ = fine_transfer
    assert not transfer(pose, pose_up="+z", pose_facing="-y").report.warnings
    noticed = 0
    for up, facing in (("+y", "+z"), ("+z", "+x"), ("-z", "-y")):
        warnings = transfer(pose, pose_up=up, pose_facing=facing).report.warnings
        said = f"pose: the axes given (up {up}, facing {facing}) seem wrong: leave them out to have them found"
        noticed += said in warnings
    assert noticed >= 2


def small_net() -> PretrainedTransfer:
    """Untrained weights with a matching."""
    torch.manual_seed(0)
    config = GeneratorConfig(extractor_widths=(8, 16), k=4, widths=(32, 16))
    return PretrainedTransfer(config.build(), config, card={"data": "humans", "vertices": 1000}).eval()


def test_the_rest_body_is_described_and_encoded_once(person, mover, monkeypatch):
    net = small_net()
    sizes = []
    encode = net.generator.encode
    monkeypatch.setattr(net.generator, "encode", lambda verts, **_: sizes.append(verts) or encode(verts, **_))
    rest = _kinds.rest_body("humans")[0]
    transfer = PoseTransfer(person, weights=net, refine=False, identity_up="+z")
    for _ in range(2):
        transfer(mover, pose_up="+z")
    same = [verts for verts in sizes if verts.shape[1] == len(rest) and torch.allclose(verts[0], center(rest[None])[0])]
    assert len(same) == 1 and len(sizes) > 12


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_weights_of_another_dtype(dtype, person, mover):
    """The axes found and the result are as with float32, as far as an untrained network's matching is stable."""
    net = small_net()
    expected = transfer_pose(person, mover, weights=net, identity_up="+z", pose_up="+z")
    result = transfer_pose(person, mover, weights=net.to(dtype), identity_up="+z", pose_up="+z")
    assert result.verts.dtype == torch.float32
    assert torch.equal(result.report.pose.rotation, expected.report.pose.rotation)
    assert_near(result.verts, expected.verts, 0.005 if dtype == torch.float64 else 0.1)


@pytest.mark.parametrize("name", ["corenet3d-animals", "xdualnet-animals"])
def test_an_animal_in_meshkits_own_frame_is_not_in_doubt(name):
    body = load_shipped("animals")[0]
    verts = body(torch.tensor([0]), torch.tensor([0]))[0]
    identity = PoseTransfer((verts, body.faces), weights=name).identity
    assert torch.equal(identity.rotation, torch.eye(3)) and identity.doubts == ()


@pytest.mark.skipif(WEIGHTS not in pretrained_names(), reason="this checkout lacks the weights")
def test_the_page_runs(capsys, tmp_path, monkeypatch):
    page = Path(__file__).parents[1] / "docs" / "transfer.md"
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    names: dict[str, object] = {}
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(blocks), page.name, "exec"), names)
    assert "unit cm (guessed from the surface area)" in capsys.readouterr().out
    assert 1e3 * float(pmd(names["result"].verts[None], center(names["target"]))[0]) < BOUND


def test_a_mesh_of_which_much_is_left_out_is_in_doubt(mover):
    """Two bodies in one file; eyes, which are far smaller, are no doubt."""
    body = load_humans()
    verts, faces = body.template, body.faces
    two = torch.cat([verts, verts + torch.tensor([2.0, 0, 0])]), torch.cat([faces, faces + len(verts)])
    eye = torch.cat([verts, 0.02 * verts]), torch.cat([faces, faces + len(verts)])
    net = copier(data="humans", usual=WIDE)
    report = transfer_pose(two, mover, weights=net, **UPRIGHT).report
    assert report.warnings == (
        "the identity mesh is in parts, and the largest, which alone is used, has 50% of the area: join those of the "
        "body into one surface, and take clothes and props away",
    )
    assert report.as_dict()["identity"]["kept_area"] == pytest.approx(0.5, abs=1e-4)
    report = transfer_pose(eye, mover, weights=net, **UPRIGHT).report
    assert report.warnings == () and "smaller parts removed: 1" in str(report)
