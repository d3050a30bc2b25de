"""Rotations and skinning against literal transcriptions."""

import numpy as np
import pytest
import torch
from conftest import rand
from literal_data import parts, skin_literally, synthetic_rig
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck

from meshkit.data import (
    RiggedModel,
    load_animals,
    load_humans,
    rotation_matrices,
    sample_bone_factors,
    sample_identities,
    sample_poses,
    scale_bones,
)


def random_rotations(*shape: int, seed: int = 0) -> Tensor:
    vectors = rand(*shape, 3, seed=seed)
    return torch.from_numpy(Rotation.from_rotvec(vectors.reshape(-1, 3).numpy()).as_matrix()).reshape(*shape, 3, 3)


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


def test_a_table_of_matrices_is_a_table_of_poses():
    model = synthetic_rig()
    matrices = rotation_matrices(model.poses)
    other = RiggedModel(**parts(model), identities=model.identities, poses=matrices, pose_names=list("abcde"))
    who, how = torch.tensor([2, 0, 2]), torch.tensor([4, 4, 1])
    torch.testing.assert_close(other(who, how), model(who, how), rtol=0, atol=1e-14)
    assert other.pose_names == tuple("abcde")
    assert other.identity_names == ()
    with pytest.raises(ValueError, match=r"poses must have shape \(5, 7, 3, 3\), got \(5, 7, 2, 3\)"):
        RiggedModel(**parts(model), poses=matrices[:, :, :2])
    with pytest.raises(ValueError, match="got 2 names for 5 rows"):
        RiggedModel(**parts(model), poses=matrices, pose_names=["a", "b"])
    with pytest.raises(ValueError, match="got 1 names for no table"):
        RiggedModel(**parts(model), identity_names=["a"])


def test_root_rotation_turns_the_whole_body():
    """Turning joint 0 is a rigid motion about it: everything else follows."""
    humans = load_humans(1000)
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
    assert {value.dtype for _, value in model.float().named_buffers() if value.is_floating_point()} == {torch.float32}
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


def test_sampled_identities_have_the_mean_and_covariance_of_the_table():
    torch.manual_seed(0)
    table = torch.randn(12, 5, dtype=torch.float64) @ torch.randn(5, 5, dtype=torch.float64) + 3
    drawn = sample_identities(table, 200_000, spread=0.5, generator=torch.Generator().manual_seed(1))
    assert torch.allclose(drawn.mean(0), table.mean(0), atol=0.02)
    assert torch.allclose(drawn.T.cov(), table.T.cov() / 4, atol=0.05)


def test_sampled_shares_sum_to_one_and_stay_in_the_span_of_the_table():
    shares = torch.eye(7)[:4]
    drawn = sample_identities(shares, 20)
    assert torch.allclose(drawn.sum(1), torch.ones(20), atol=1e-5)
    assert bool((drawn[:, 4:] == 0).all())  # other bodies stay unseen


# Joint 0 is the root, 1 to 3 the spine, 4 a leg with its foot 5, 6 and 7 arms (with two fingers the second), 10 a head.
BRANCHED = torch.tensor([-1, 0, 1, 2, 0, 4, 3, 3, 7, 7, 3])


def test_sampled_poses_have_the_trunk_of_one_and_each_limb_of_one():
    """All joints of a part come from one pose; parts come from each pose equally often, and independently."""
    parts = [[0, 1, 2, 3], [4, 5], [6], [7, 8, 9], [10]]
    table = torch.arange(3.0)[:, None, None, None].expand(3, 11, 3, 3)
    for poses in (table, table[..., 0]):
        donors = sample_poses(poses, BRANCHED, 9000, generator=torch.Generator().manual_seed(1)).flatten(2)
        assert bool((donors == donors[..., :1]).all())
        donors = donors[..., 0]
        for part in parts:
            assert bool((donors[:, part] == donors[:, part[:1]]).all())
        of_part = donors[:, [part[0] for part in parts]]
        for i, a in enumerate(of_part.T):
            for b in of_part.T[:i]:
                counts = (3 * a + b).long().bincount(minlength=9)
                assert bool(((counts - 1000).abs() < 130).all())  # over four standard deviations


def test_sampled_poses_are_repeated_by_the_generator():
    poses = torch.randn(5, 11, 3)
    first, again = (sample_poses(poses, BRANCHED, 4, generator=torch.Generator().manual_seed(2)) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, sample_poses(poses, BRANCHED, 4, generator=torch.Generator().manual_seed(3)))


def test_sampled_poses_need_poses_of_the_joints():
    with pytest.raises(ValueError, match=r"poses of 11 joints .* got \(4, 10, 3\)"):
        sample_poses(torch.randn(4, 10, 3), BRANCHED, 2)
    with pytest.raises(ValueError, match=r"got \(0, 11, 3\)"):
        sample_poses(torch.randn(0, 11, 3), BRANCHED, 2)
    for parents in ([-1, 0, 1, -1, 3], [3, 0, 1, -1, 2]):
        with pytest.raises(ValueError, match="joint 0 must be the root"):
            sample_poses(torch.randn(4, 5, 3), torch.tensor(parents), 2)


def test_bones_are_scaled_as_the_equation_says():
    body = synthetic_rig()
    verts, joints = body.shape(torch.tensor([0, 1]))
    factors = rand(2, body.num_joints, 3).exp()
    moved, placed = scale_bones(verts, joints, body.weights, body.parents, factors)
    for b in range(2):
        q = [joints[b, 0]]
        for j, parent in enumerate(body.parents.tolist()[1:], 1):
            q.append(q[parent] + factors[b, parent].diag() @ (joints[b, j] - joints[b, parent]))
        for v in range(verts.shape[1]):
            place = sum(
                w * (factors[b, j].diag() @ (verts[b, v] - joints[b, j]) + q[j]) for j, w in enumerate(body.weights[v])
            )
            assert torch.allclose(moved[b, v], place, rtol=0, atol=1e-12)
        assert torch.allclose(placed[b], torch.stack(q), rtol=0, atol=1e-13)
    one = torch.ones_like(factors)
    assert all(map(torch.allclose, scale_bones(verts, joints, body.weights, body.parents, one), (verts, joints)))
    grown, _ = scale_bones(verts, joints, body.weights, body.parents, 2 * one)  # all alike: about the root
    assert torch.allclose(grown - joints[:, :1], 2 * (verts - joints[:, :1]))


def test_bone_factors_are_those_of_limbs_and_of_both_sides():
    """Logarithms of mean 0; a limb's joints have variance 3/2, covariance 5/4, 1 between axes; sides are alike."""
    humans = load_humans(1000)
    factors = sample_bone_factors(humans.joints, humans.parents, 20_000, spread=0.3).double().log() / 0.3
    assert factors.mean((0, 2)).abs().max() < 0.03
    knee, ankle, other_knee, head = 4, 5, 10, 16  # of the shipped humans; the legs are its second and third limb
    assert humans.joints[[knee, other_knee], 0].sum().abs() < 1e-3
    assert torch.equal(factors[:, knee], factors[:, other_knee])
    assert not torch.equal(factors[:, knee], factors[:, ankle])
    cov = torch.stack([factors[:, knee, 2], factors[:, ankle, 2], factors[:, ankle, 0], factors[:, head, 2]]).cov()
    alike = [[1.5, 1.25, 1.0, 0.0], [1.25, 1.5, 1.0, 0.0], [1.0, 1.0, 1.5, 0.0], [0.0, 0.0, 0.0, 1.5]]
    expected = torch.tensor(alike, dtype=torch.float64)
    assert torch.allclose(cov, expected, atol=0.05)
    assert torch.equal(
        *(
            sample_bone_factors(
                humans.joints, humans.parents, 2, spread=0.2, generator=torch.Generator().manual_seed(1)
            )
            for _ in range(2)
        )
    )
    assert bool((sample_bone_factors(humans.joints, humans.parents, 2, spread=0.0) == 1).all())


@pytest.mark.parametrize("load", [load_animals, load_humans])
def test_bone_factors_of_all_joints_are_those_of_their_mirror_images(load):
    """Also where joints lie at one place, as the hips at the root and the fingers' roots in the hand."""
    body = load()
    at = body.joints - body.joints[0]
    factors = sample_bone_factors(body.joints, body.parents, 3, spread=0.3)
    for joint, place in enumerate(at):
        alike = [other for other in range(len(at)) if torch.equal(factors[:, joint], factors[:, other])]
        assert len(alike) <= 2
        if abs(place[0]) > 0.02:
            assert len(alike) == 2 and torch.allclose(
                at[sum(alike) - joint], place * torch.tensor([-1.0, 1, 1]), atol=0.01
            )


def test_bones_of_other_shapes_are_refused():
    body = synthetic_rig()
    verts, joints = body.shape(torch.tensor([0]))
    with pytest.raises(ValueError, match=r"factors must have shape \(1, \d+, 3\), got \(2, 3\)"):
        scale_bones(verts, joints, body.weights, body.parents, torch.ones(2, 3))
    with pytest.raises(ValueError, match="joint 0 must be the root"):
        scale_bones(verts, joints, body.weights, body.parents.flip(0), torch.ones_like(joints))
    with pytest.raises(ValueError, match=r"joints must have shape \(\d+, 3\), got \(1, \d+, 3\)"):
        sample_bone_factors(joints, body.parents, 2, spread=0.1)
    with pytest.raises(ValueError, match=r"count and spread must not be negative, got 2 and -0\.1"):
        sample_bone_factors(joints[0], body.parents, 2, spread=-0.1)


def test_sampling_needs_two_identities():
    with pytest.raises(ValueError, match=r"at least two rows.*\(1, 3\)"):
        sample_identities(torch.randn(1, 3), 4)


@pytest.mark.parametrize(
    ("count", "spread", "message"),
    [
        (-1, 1.0, "count and spread must not be negative, got -1 and 1.0"),
        (2, -0.5, "got 2 and -0.5"),
        (2, float("nan"), "got 2 and nan"),
    ],
)
def test_samples_of_no_number_are_refused(count, spread, message):
    with pytest.raises(ValueError, match=message):
        sample_identities(torch.randn(4, 3), count, spread=spread)
    with pytest.raises(ValueError, match="NaN or infinite"):
        sample_identities(torch.full((4, 3), torch.nan), 2)
    with pytest.raises(ValueError, match="count must not be negative, got -1"):
        sample_poses(torch.zeros(2, 3, 3), torch.tensor([-1, 0, 1]), -1)
