"""Left and right: the minimum cut against all labellings, and exchanged limbs of a body."""

from itertools import product

import pytest
import torch
import trimesh
from conftest import rand

from meshkit.batching import pad
from meshkit.data import load_humans
from meshkit.models import PoseTransferGenerator, generator, symmetry
from meshkit.models.symmetry import least_labels, minimum_cut, mirror_labels, spanning_labels
from meshkit.neighbors import gather_vertices, knn


@pytest.mark.parametrize("seed", range(8))
def test_minimum_cut_finds_the_least_of_all_labellings(seed):
    generator = torch.Generator().manual_seed(seed)
    tails, heads = torch.randint(9, (2, 24), generator=generator)
    capacities, costs = rand(24, seed=seed).abs(), 2 * rand(9, seed=seed + 50)

    def energy(x: torch.Tensor) -> float:
        return float((capacities * (~x[tails] & x[heads])).sum() + (costs * x).sum())

    least = min(energy(torch.tensor(x)) for x in product([False, True], repeat=9))
    assert energy(minimum_cut(tails, heads, capacities, costs)) == pytest.approx(least, abs=24 * 1e-3)


def test_minimum_cut_without_edges_follows_the_costs():
    none = torch.empty(0, dtype=torch.int64)
    assert minimum_cut(none, none, torch.empty(0), torch.tensor([1.0, -1.0])).tolist() == [False, True]


def energy_of(x: torch.Tensor, tails: torch.Tensor, heads: torch.Tensor, costs: torch.Tensor) -> float:
    return float(costs[x[tails].long(), x[heads].long(), torch.arange(len(tails))].sum())


@pytest.mark.parametrize("seed", range(8))
def test_least_labels_are_the_least_on_a_tree_and_where_wishes_agree(seed):
    """Whatever the wishes on a tree, and on any graph if some labelling grants all of them."""
    generator = torch.Generator().manual_seed(seed)
    num = 10
    tails = torch.arange(1, num)
    heads = torch.tensor([int(torch.randint(i, (1,), generator=generator)) for i in tails.tolist()])
    costs = rand(2, 2, num - 1, seed=seed).abs()
    everything = [torch.tensor(x) for x in product([False, True], repeat=num)]
    best = min(energy_of(x, tails, heads, costs) for x in everything)
    assert energy_of(least_labels(tails, heads, costs, num), tails, heads, costs) == pytest.approx(best, abs=2e-2)

    tails, heads = torch.randint(num, (2, 30), generator=generator)
    hidden, costs = torch.rand(num, generator=generator) < 0.5, rand(2, 2, 30, seed=seed).abs()
    differ = hidden[tails] != hidden[heads]
    costs[0, 0] += 3 * differ
    costs[1, 1] += 3 * differ
    costs[0, 1] += 3 * ~differ
    costs[1, 0] += 3 * ~differ
    best = min(energy_of(x, tails, heads, costs) for x in everything)
    assert energy_of(least_labels(tails, heads, costs, num), tails, heads, costs) == pytest.approx(best, abs=5e-2)


def frustrated(seed: int, num: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ten edges whose wishes no labelling grants all."""
    generator = torch.Generator().manual_seed(seed)
    pairs = torch.combinations(torch.arange(num))
    heads, tails = pairs[torch.randperm(len(pairs), generator=generator)[:10]].T
    differ, costs = torch.rand(10, generator=generator) < 0.5, rand(2, 2, 10, seed=seed).abs()
    costs[0, 0] += differ
    costs[1, 1] += differ
    costs[0, 1] += ~differ
    costs[1, 0] += ~differ
    return tails, heads, costs


def test_least_labels_where_wishes_contradict():
    """Never worse than the spanning tree's, which they start from; often better, and often the best of all."""
    excess = []
    for seed in range(24):
        tails, heads, costs = frustrated(seed)
        everything = [torch.tensor(x) for x in product([False, True], repeat=6)]
        best = min(energy_of(x, tails, heads, costs) for x in everything)
        start = spanning_labels(tails, heads, costs[0, 0] + costs[1, 1] - costs[0, 1] - costs[1, 0], 6)
        found = least_labels(tails, heads, costs, 6)
        excess.append([energy_of(x, tails, heads, costs) - best for x in (start, found)])
    before, after = torch.tensor(excess).T
    assert (after <= before + 2e-2).all()
    assert after.sum() < before.sum() / 3 and (after < 2e-2).sum() > 2 * (before < 2e-2).sum()


def test_least_labels_do_not_depend_on_the_direction_of_edges():
    """What no cut can express is shared between the two ways in which the ends may differ."""
    for seed in range(24):
        tails, heads, costs = frustrated(seed)
        turned = least_labels(heads, tails, costs.transpose(0, 1), 6)
        assert torch.equal(turned, least_labels(tails, heads, costs, 6))


@pytest.fixture(scope="module")
def person() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rest shape, faces, posed shape, and the vertex nearest to each vertex's mirror image."""
    body = load_humans()
    rest = body.shape(torch.tensor([3]))[0][0]
    posed = body(torch.tensor([3]), torch.tensor([40]))[0]
    partner = knn(rest[None], 1, query=(rest * torch.tensor([-1.0, 1, 1]))[None])[0, :, 0]
    return rest, body.faces, posed, partner


def below_the_knees(rest: torch.Tensor) -> torch.Tensor:
    low, high = rest[:, 2].amin(), rest[:, 2].amax()
    return rest[:, 2] < low + 0.25 * (high - low)


def test_exchanged_calves_are_put_right(person):
    rest, faces, posed, partner = person
    wrong = below_the_knees(rest)
    matched = torch.where(wrong[:, None], posed[partner], posed)
    mirrored = torch.where(wrong[:, None], posed, posed[partner])
    labels = mirror_labels(rest, faces, matched, mirrored, partner)
    assert (labels == wrong).float().mean() > 0.95  # around the knee either will do
    mended = torch.where(labels[:, None], mirrored, matched)
    assert (mended - posed).norm(dim=1).max() < 0.1 < (matched - posed).norm(dim=1).max()


@pytest.mark.parametrize("inwards", [False, True])
def test_a_good_matching_is_left_alone_and_a_mirrored_one_turned(person, inwards):
    """Up to vertices at the middle, where a vertex and its partner are one place."""
    rest, faces, posed, partner = person
    faces = faces.flip(1) if inwards else faces
    for matched, mirrored in ((posed, posed[partner]), (posed[partner], posed)):
        labels = mirror_labels(rest, faces, matched, mirrored, partner)
        assert (torch.where(labels[:, None], mirrored, matched) - posed).norm(dim=1).max() < 0.03


def test_a_fold_is_not_taken(monkeypatch):
    """With the left limb in shreds, both limbs on the right one's place is the lesser tear, and has no volume."""
    boxes = [trimesh.creation.box((0.4, 0.4, 4.0)).subdivide().subdivide() for _ in range(2)]
    limb, num = torch.tensor(boxes[0].vertices), len(boxes[0].vertices)
    side = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    rest = torch.cat([limb - side, limb * (1 - 2 * side) + side])  # vertex i + num is the mirror image of vertex i
    faces = torch.tensor(boxes[0].faces)
    top = limb[:, 2].argsort(descending=True)[:2].tolist()
    hip = torch.tensor([[top[0], top[1], top[0] + num], [top[1], top[1] + num, top[0] + num]])
    faces = torch.cat([faces, faces.flip(1) + num, hip])
    left = torch.arange(2 * num)[:, None] >= num
    shreds = torch.where(left, rest + 0.3 * rand(2 * num, 3), rest)
    opposite = torch.cat([rest[num:], rest[:num]])
    mirrored = torch.where(left, opposite, torch.cat([shreds[num:], shreds[:num]]))
    labels = [None, None]
    for place, share in enumerate((0.0, symmetry._WHOLE)):
        monkeypatch.setattr(symmetry, "_WHOLE", share)
        labels[place] = mirror_labels(rest, faces, shreds, mirrored, torch.arange(2 * num))
    assert (labels[0] == left[:, 0]).float().mean() > 0.9  # what the energy alone would take
    assert not labels[1].any()


def test_labels_do_not_depend_on_unit_place_and_order(person):
    rest, faces, posed, partner = person
    wrong = below_the_knees(rest)[:, None]
    matched, mirrored = (torch.where(x, posed[partner], posed) for x in (wrong, ~wrong))
    labels = mirror_labels(rest, faces, matched, mirrored, partner)
    moved = mirror_labels(100 * rest + 3, faces, 100 * matched - 7, 100 * mirrored - 7, partner)
    order = torch.randperm(len(rest), generator=torch.Generator().manual_seed(0))
    back = order.argsort()
    shuffled = mirror_labels(rest[order], back[faces], matched[order], mirrored[order], back[partner[order]])
    for other in (moved, shuffled[back]):
        assert (other == labels).float().mean() > 0.95


def test_no_edges_no_labels():
    points = torch.zeros(3, 3)
    assert not mirror_labels(points, torch.empty(0, 3, dtype=torch.int64), points, points, torch.arange(3)).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"targets": torch.zeros(4, 3)}, r"must all be \(N, 3\), got \(5, 3\), \(4, 3\)"),
        ({"verts": torch.zeros(5, 2)}, r"must all be \(N, 3\), got \(5, 2\)"),
        ({"partner": torch.arange(4)}, r"partner must be \(5,\), got \(4,\)"),
        ({"partner": torch.arange(1, 6)}, r"partner must be in \[0, 5\), got 1 to 5"),
        ({"partner": torch.arange(5) - 1}, r"partner must be in \[0, 5\), got -1 to 3"),
        ({"faces": torch.tensor([[0, 1, 5]])}, r"faces must be in \[0, 5\), got 0 to 5"),
        ({"targets": torch.full((5, 3), torch.nan)}, "targets must be finite"),
        ({"mirrored": torch.full((5, 3), torch.inf)}, "mirrored must be finite"),
    ],
)
def test_errors(change, message):
    inputs = {name: torch.zeros(5, 3) for name in ("verts", "targets", "mirrored")} | {"partner": torch.arange(5)}
    inputs |= {"faces": torch.tensor([[0, 1, 2]])}
    with pytest.raises(ValueError, match=message):
        mirror_labels(**(inputs | change))


def test_the_generator_looks_at_both_hands_in_evaluation_only(monkeypatch):
    """Padded meshes as by themselves; without faces, in training, or without the option, nothing changes."""
    torch.manual_seed(0)
    net = PoseTransferGenerator(extractor_widths=(8, 16), k=6, widths=(16, 8), residual=True, symmetry=True).eval()
    body = load_humans()
    verts = [body(torch.tensor([i]), torch.tensor([10 * i]))[0] for i in range(4)]
    (a, mask), faces = pad([verts[0], verts[1][:900]]), [body.faces, body.faces[(body.faces < 900).all(1)]]
    padded = torch.full((2, len(body.faces), 3), -1)
    for row, own in zip(padded, faces, strict=True):
        row[: len(own)] = own
    b = torch.stack(verts[2:])

    def half(verts, faces, targets, mirrored, partner):
        assert partner.min() >= 0 and max(partner.max(), faces.max()) < len(verts) == len(targets)
        return verts[:, 2] > 0

    monkeypatch.setattr(generator, "mirror_labels", half)
    with torch.no_grad():
        plain, handed = net(a, b, identity_mask=mask), net(a, b, identity_mask=mask, identity_faces=padded)
        assert (plain.vertices - handed.vertices).abs().max() > 1e-2
        for i, n in ((0, 1000), (1, 900)):
            alone = net(a[i : i + 1, :n], b[i : i + 1], identity_faces=faces[i]).vertices[0]
            assert (alone - handed.vertices[i, :n]).abs().max() < 1e-4
        net.symmetry = False
        assert torch.equal(net(a, b, identity_mask=mask, identity_faces=padded).vertices, plain.vertices)
    net.symmetry = True
    monkeypatch.setattr(generator, "mirror_labels", None)
    net.train()(a[:1], b[:1], identity_faces=faces[0])


@pytest.mark.parametrize("released", [False, True])
def test_gradients_pass_the_choice_of_hands(monkeypatch, released):
    """The choice has no derivative; both matchings it chooses from have, by finite differences."""
    torch.manual_seed(0)
    options = {"extractor_widths": (5, 6), "k": 4, "widths": (8,), "released": released, "symmetry": True}
    net = PoseTransferGenerator(**options).double().eval()
    net.transfer.narrow[-1].weight.data = rand(*net.transfer.narrow[-1].weight.shape)
    identity, pose, faces = rand(1, 9, 3), rand(1, 8, 3, seed=1), torch.tensor([[0, 1, 2], [2, 3, 4]])
    monkeypatch.setattr(generator, "mirror_labels", lambda verts, *rest: torch.arange(len(verts)) % 2 == 0)
    own, other = net.encode(identity).detach().requires_grad_(), net.encode(pose).detach().requires_grad_()

    def moved(own, other):
        output = net(identity, pose, identity_features=own, pose_features=other, identity_faces=faces)
        return output.vertices, output.warped

    assert torch.autograd.gradcheck(moved, (own, other))
    (slope,) = torch.autograd.grad(moved(own, other)[1].square().sum(), own)
    rows = slope[0].abs().sum(1) > 1e-9
    assert rows.tolist() == [i % 2 == 1 for i in range(9)]  # those that keep their own features
    # The others' are the mirror image's, which go back to the extractor.
    monkeypatch.setattr(generator, "mirror_labels", lambda verts, *rest: torch.ones(len(verts), dtype=torch.bool))
    net(identity, pose, identity_features=own, pose_features=other, identity_faces=faces).warped.sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in net.extractor.parameters())


@pytest.mark.parametrize("masked", [False, True])
def test_an_identity_beside_a_batch_is_looked_at_once(monkeypatch, masked):
    """Its mirror image too; the result is that of copies."""
    torch.manual_seed(0)
    net = PoseTransferGenerator(extractor_widths=(8, 16), k=6, widths=(16, 8), residual=True, symmetry=True).eval()
    identity, poses, faces = rand(1, 30, 3).float(), rand(3, 20, 3, seed=1).float(), torch.randint(25, (40, 3))
    mask = torch.arange(30)[None] < 25 if masked else None
    looked, encode = [], net.encode
    monkeypatch.setattr(net, "encode", lambda verts, **known: looked.append(len(verts)) or encode(verts, **known))
    given = {"identity_features": encode(identity, mask=mask), "pose_features": encode(poses)}
    results = []
    for repeat in (lambda x: x.expand(3, *x.shape[1:]), lambda x: x.repeat(3, *[1] * (x.dim() - 1))):
        known = {"identity_features": repeat(given["identity_features"]), "pose_features": given["pose_features"]}
        known |= {"identity_mask": None if mask is None else repeat(mask), "identity_faces": faces}
        results.append(net(repeat(identity), poses, **known).vertices)
    assert looked == [1, 3]
    assert (results[0] - results[1]).abs().max() < 1e-5


def test_gathered_mirror_image_is_the_mirror_image(person):
    """The fixture's partners: nearly symmetric at rest, so that a partner's partner is close."""
    rest, _, _, partner = person
    image = gather_vertices((rest * torch.tensor([-1.0, 1, 1]))[None], partner[None])[0]
    assert (image - rest).norm(dim=1).mean() < 0.03
