"""What --data means: training pairs, and test pairs of unseen identities in unseen poses."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from _run import Run, UserError
from torch import Tensor, nn

from meshkit._names import did_you_mean
from meshkit.data import (
    RELEASED_SPLITS,
    MeshEntry,
    MeshPairs,
    MeshPool,
    MeshStore,
    PairBatch,
    PosePairs,
    RiggedModel,
    Split,
    load_shipped,
    load_smal,
    load_smpl,
    sample_bone_factors,
    sample_identities,
    sample_poses,
    scale_bones,
    scan_faust,
    scan_mgn,
    scan_pose_transfer,
)
from meshkit.io import MeshFileError
from meshkit.models import NPT
from meshkit.models.pretrained import extents, usual_extents

KINDS = "humans, animals, smpl:<file>, smal:<file>, faust:<folder>, mgn:<folder> or folder:<folder>"
SCANNERS = {"faust": scan_faust, "mgn": scan_mgn, "folder": scan_pose_transfer}
Pairs = PosePairs | MeshPairs
IN_METRES = ("humans", "smpl", "faust", "mgn")
"""Kinds of --data whose bodies are in metres; the animals' unit is arbitrary, that of other folders unknown."""


def unit_of(kind: str) -> str:
    """The unit of lengths in reports: ``m``, or ``units``."""
    return "m" if kind.partition(":")[0] in IN_METRES else "units"


def data(cfg: Any, run: Run, workers: int, device: torch.device | str = "cpu") -> tuple[Pairs, Pairs]:
    """Training and test pairs of ``--data``; those of rigged bodies are made on ``device``."""
    kind, _, place = cfg.data.partition(":")
    kinds = ("humans", "animals", "smpl", "smal", *SCANNERS)
    if kind not in kinds or (kind in ("humans", "animals")) == bool(place):
        raise UserError(f"--data must be {KINDS}; got {cfg.data!r}{did_you_mean(kind, kinds)}")
    if place and not Path(place).exists():
        raise UserError(f"--data {cfg.data}: there is no {place}")
    try:
        if kind in SCANNERS:
            if cfg.sampled_identities or cfg.sampled_poses:
                flag = "identities" if cfg.sampled_identities else "poses"
                raise UserError(f"--sampled-{flag} needs a rig, whose {flag} have coefficients: drop it")
            return files(cfg, run, workers, SCANNERS[kind](place))
        body, split = rigged(kind, Path(place)) if place else load_shipped(kind, cfg.vertices)
        if cfg.sampled_identities:
            body, split = with_sampled_identities(body, split, cfg.sampled_identities, cfg.seed, cfg.bone_spread)
        if cfg.sampled_poses:
            body, split = with_sampled_poses(body, split, cfg.sampled_poses, cfg.seed)
    except ValueError as error:
        raise UserError(f"--data {cfg.data}: {error}") from None
    train, test = posed(cfg, run, workers, body, split)
    return train.to(device), test.to(device)


def inputs(batch: PairBatch) -> dict[str, Tensor | None]:
    """What a generator is told beside the vertices."""
    return {
        "identity_mask": batch.identity_mask,
        "pose_mask": batch.pose_mask,
        "identity_descriptors": batch.identity_descriptors,
        "pose_descriptors": batch.pose_descriptors,
    }


def told(generator: nn.Module, known: Mapping[str, Tensor | None]) -> dict[str, Tensor | None]:
    """Of what is known beside the vertices, that which a generator takes in evaluation.

    NPT takes no descriptors, which a pool may have computed for others; what resolves exchanged limbs takes the
    identity's faces.
    """
    names = ["identity_mask", "pose_mask"]
    if not isinstance(generator, NPT):
        names += ["identity_descriptors", "pose_descriptors"]
    if getattr(generator, "symmetry", False):
        names.append("identity_faces")
    return {name: known.get(name) for name in names}


def rigged(kind: str, file: Path) -> tuple[RiggedModel, Split]:
    """SMPL or SMAL with tables of identities and poses drawn once, one in five of each kept for testing.

    Shapes are standard normal coefficients, or SMAL's toys where its data file (``..._data.pkl``) lies beside the
    model. Poses turn each joint but the root by normal angles of 0.2 to 0.3 radians about random axes.
    """
    if kind == "smpl":
        body = load_smpl(file, z_up=True)
    else:
        beside = file.with_name(f"{file.stem}_data{file.suffix}")
        body = load_smal(file, beside if beside.exists() else None)
    draw = torch.Generator().manual_seed(0)
    if body.identities is None:
        body.identities = torch.randn(200, len(body.shape_dirs), generator=draw).clamp(-3, 3)
    poses = (0.3 if kind == "smpl" else 0.2) * torch.randn(1000, len(body.joints), 3, generator=draw)
    poses[:, 0] = 0.0
    body.poses = poses
    return body, drawn_split(len(body.identities), len(poses), draw)


def with_sampled_identities(
    body: RiggedModel, split: Split, count: int, seed: int, bone_spread: float = 0.0
) -> tuple[RiggedModel, Split]:
    """A body and split with ``count`` more training identities, like the known training ones.

    With ``bone_spread`` their limbs are stretched at random (:func:`meshkit.data.scale_bones`): each becomes a shape
    direction of its own, as it is no mixture of the known ones any more.
    """
    first = None if body.identities is None else len(body.identities)
    body, split = with_more(
        body, split, "identity", seed, lambda known, draw: sample_identities(known, count, spread=0.7, generator=draw)
    )
    if not bone_spread:
        return body, split
    assert body.identities is not None
    draw = torch.Generator().manual_seed(seed + 1)  # not the numbers that the identities were drawn with
    factors = sample_bone_factors(body.joints, body.parents, count, spread=bone_spread, generator=draw)
    verts, joints = scale_bones(*body.shape(body.identities[first:]), body.weights, body.parents, factors)
    known, added = body.identities[:first], torch.eye(count)
    body.identities = torch.block_diag(known, added)
    body.shape_dirs = torch.cat([body.shape_dirs, verts - body.template])
    body.joint_dirs = torch.cat([body.joint_dirs, joints - body.joints])
    return body, split


def with_sampled_poses(body: RiggedModel, split: Split, count: int, seed: int) -> tuple[RiggedModel, Split]:
    """A body and split with ``count`` more training poses, put together from the known training ones."""
    parents = body.parents
    return with_more(body, split, "pose", seed, lambda known, draw: sample_poses(known, parents, count, generator=draw))


def with_more(
    body: RiggedModel, split: Split, what: str, seed: int, make: Callable[[Tensor, torch.Generator], Tensor]
) -> tuple[RiggedModel, Split]:
    """A body with more identities or poses, made of the known training ones, and a split that trains on them too."""
    table = {"identity": "identities", "pose": "poses"}[what]
    known, rows = getattr(body, table), getattr(split, f"train_{table}")
    if known is None:
        raise UserError(f"this rig has no {table} to make others of")
    new = make(known[rows], torch.Generator().manual_seed(seed))
    setattr(body, table, torch.cat([known, new]))
    setattr(body, f"{what}_names", ())
    return body, replace(split, **{f"train_{table}": torch.cat([rows, len(known) + torch.arange(len(new))])})


def drawn_split(identities: int, poses: int, draw: torch.Generator) -> Split:
    who, how = torch.randperm(identities, generator=draw), torch.randperm(poses, generator=draw)
    a, b = max(1, identities // 5), max(1, poses // 5)
    rows = [side[torch.randint(len(side), (400,), generator=draw)] for side in (who[:a], how[:b], who[:a], how[:b])]
    return Split(who[a:].sort()[0], who[:a].sort()[0], how[b:].sort()[0], how[:b].sort()[0], torch.stack(rows, 1))


def files(cfg: Any, run: Run, workers: int, entries: list[MeshEntry]) -> tuple[MeshPairs, MeshPairs]:
    """Pairs of meshes from files: the released split where their numbers are those of a released data set."""
    for name in ("humans", "animals"):
        train, test = (RELEASED_SPLITS[f"{name}-{side}"].select(entries) for side in ("train", "test"))
        if len(train) > 1 and len(test) > 1:
            break
    else:
        # One in five identities and poses, at least two of each, to test on: the last ones.
        people, poses = ({getattr(e, name) for e in entries} for name in ("identity", "pose"))
        last_people, last_poses = (set(sorted(x)[-max(2, len(x) // 5) :]) for x in (people, poses))
        train = [e for e in entries if e.identity not in last_people and e.pose not in last_poses]
        test = [e for e in entries if e.identity in last_people and e.pose in last_poses]
    stores = []
    for side, chosen in (("train", train), ("test", test)):
        if len(chosen) < 2:
            raise UserError(
                f"--data {cfg.data}: {len(chosen)} meshes to {side} on are too few, of {len(entries)}: two identities "
                "and two poses or more are set apart to test on, and two other meshes are needed to train on"
            )
        # Every process reads the cache; who comes first has made it.
        where = run.path(f"cache_{side}")
        try:
            with plain_warnings():
                stores.append(MeshStore.build(chosen, where, skip_bad=cfg.skip_bad, progress=run.writes))
        except MeshFileError as error:
            advice = "" if cfg.skip_bad else "; remove the file, or leave out such files with --skip-bad"
            raise UserError(f"--data {cfg.data}: {error}{advice}") from None
        if len(stores[-1]) < 2:
            raise UserError(f"--data {cfg.data}: {len(stores[-1])} readable meshes to {side} on are too few")
        if cfg.model.descriptors == "wks" and not (cfg.steps == 0 and side == "train"):
            try:
                stores[-1].describe(num_signatures=cfg.model.num_signatures, workers=workers, progress=run.writes)
            except MeshFileError as error:
                # Weights to begin with are of a network that takes signatures.
                without = "" if cfg.init else ", or train without signatures (--model.descriptors none)"
                raise UserError(
                    f"--data {cfg.data}: {error}; mend the mesh (meshkit.io.clean_mesh) or remove it{without}"
                ) from None
    common: dict[str, Any] = {"seed": cfg.seed}
    if run.writes:
        tell(stores, cfg.eval_pairs)
        tell_size(stores[0])
        tell_left_out(entries, train, test)
    train_pairs = MeshPairs(stores[0], length=cfg.pairs, resample=cfg.resample, ground_truth=cfg.ground_truth, **common)
    return train_pairs, MeshPairs(stores[1], length=cfg.eval_pairs, ground_truth=known(stores[1]), **common)


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Warnings as lines of the error stream, without the place in the code that Python puts around them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        finally:
            for warning in caught:
                print(f"warning: {warning.message}", file=sys.stderr)


def tell(stores: list[MeshStore], eval_pairs: int) -> None:
    """Say how much there is on each side; few test meshes make few distinct pairs."""
    for side, store in zip(("train", "test"), stores, strict=True):
        people, poses = len(store.identity.unique()), len(store.pose.unique())
        print(f"{len(store)} meshes to {side} on: {people} identities, {poses} poses", flush=True)
    possible = len(stores[1]) * (len(stores[1]) - 1)
    if possible < eval_pairs:
        print(
            f"warning: {len(stores[1])} test meshes make {possible} distinct pairs at most; the figures on "
            f"{eval_pairs} pairs repeat them",
            file=sys.stderr,
        )


def tell_size(store: MeshStore) -> None:
    """Warn of meshes whose unit cannot be the one that the settings, and shipped weights, are for."""
    some = range(0, len(store), -(-len(store) // 32))
    side = float(torch.stack([extents(store.view("verts", k)).max() for k in some]).median())
    low, high = usual_extents("animals")  # people are within these too
    if not low < side < high:
        print(
            f"warning: the meshes are {side:.3g} long; the settings are for bodies of {low:g} to {high:g} (metres): "
            "scale the files",
            file=sys.stderr,
        )


def tell_left_out(entries: list[MeshEntry], train: list[MeshEntry], test: list[MeshEntry]) -> None:
    """Say which meshes are on neither side of the split, and why."""
    (people, poses), (unseen_people, unseen_poses) = (
        ({e.identity for e in side}, {e.pose for e in side}) for side in (train, test)
    )
    taken = {e.path for e in (*train, *test)}
    groups: dict[str, list[str]] = {}
    for e in entries:
        if e.path in taken:
            continue
        if e.identity in unseen_people and e.pose in poses:
            why = "an identity to test on in a pose to train on"
        elif e.identity in people and e.pose in unseen_poses:
            why = "an identity to train on in a pose to test on"
        else:
            why = "an identity or a pose of neither side"
        groups.setdefault(why, []).append(e.path.name)
    if groups:
        count = sum(map(len, groups.values()))
        print(f"{count} of {len(entries)} meshes are on neither side: what is tested on must be new", flush=True)
    for why, names in groups.items():
        shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        print(f"  {len(names)} of {why}: {shown}", flush=True)


def some_descriptors(pairs: Pairs, most: int = 256) -> Tensor | None:
    """Descriptors of training meshes, those of at most ``most`` files; ``None`` if there are none."""
    if isinstance(pairs, PosePairs):
        return None if pairs.pool is None else pairs.pool.descriptors
    if not pairs.descriptor_width:
        return None
    store = pairs.store
    return torch.cat([store.view("descriptors", k) for k in range(0, len(store), -(-len(store) // most))])


def known(store: MeshStore) -> bool:
    """Whether two identities share a pose, so that there is a ground truth."""
    pairs = torch.stack([store.pose, store.identity], 1).unique(dim=0)
    return bool((pairs[:, 0].unique(return_counts=True)[1] > 1).any())


def posed(cfg: Any, run: Run, workers: int, body: RiggedModel, split: Split) -> tuple[PosePairs, PosePairs]:
    """Pairs of a rigged body, with signatures from a pool of meshes where the model asks for them."""
    listed = split.test_pairs[: cfg.eval_pairs]
    pools: dict[str, MeshPool | None] = {"train": None, "test": None}
    if cfg.model.descriptors == "wks":
        shared: dict[str, Any] = {"num_signatures": cfg.model.num_signatures, "workers": workers, "progress": True}
        who, how = listed.view(-1, 2).unbind(1)
        make = {
            "train": lambda: MeshPool.build(
                body, split.train_identities, split.train_poses, cfg.pool, seed=cfg.seed, **shared
            ),
            "test": lambda: MeshPool.of(body, who, how, **shared),
        }
        for side in pools:
            key = f"{side}, {cfg.data}, {len(body.template)} vertices, {cfg.model.num_signatures} signatures, "
            if side == "train":
                for what in ("identities", "poses"):
                    count = getattr(cfg, f"sampled_{what}")
                    key += f"{count} sampled {what}, " if count else ""
                key += f"limbs stretched as a whole by {cfg.bone_spread}, " if cfg.bone_spread else ""
            key += f"pool {cfg.pool}, seed {cfg.seed}" if side == "train" else f"{len(listed)} pairs"
            stored = run.load_tensors(f"pool_{side}.safetensors", key)
            if stored is None:
                print(f"meshes to {side} on:", flush=True)
                stored = make[side]().state_dict()
                run.save_tensors(f"pool_{side}.safetensors", stored, key)
            pools[side] = MeshPool(**stored)
    train = PosePairs(
        body,
        split.train_identities,
        split.train_poses,
        length=cfg.pairs,
        seed=cfg.seed,
        resample=cfg.resample,
        pool=pools["train"],
        ground_truth=cfg.ground_truth,
    )
    return train, PosePairs(body, split.test_identities, split.test_poses, pool=pools["test"], listed=listed)
