"""The pose-transfer generator of 3D-CoreNet and X-DualNet."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from meshkit._checks import check_whole, check_widths
from meshkit._repr import settings
from meshkit.batching import masked_mean
from meshkit.deform import poisson_deform, rigid_moving_least_squares
from meshkit.models._released_matching import STABILIZER, DensePlan, stabilized_matching
from meshkit.models.ordered import OrderedPoseTransferStack
from meshkit.models.output import GeneratorOutput
from meshkit.models.pointwise import PointwiseExtractor
from meshkit.models.stack import PoseTransferStack
from meshkit.models.symmetry import mirror_labels
from meshkit.nn import SetConvExtractor
from meshkit.norm import ConditionalNorm, ElaIN, SPAdaIN
from meshkit.ot import TransportPlan, sinkhorn

__all__ = ["GeneratorOutput", "PoseTransferGenerator"]

_NORMS: dict[str, type[ConditionalNorm]] = {"elain": ElaIN, "spadain": SPAdaIN}


class PoseTransferGenerator(nn.Module):
    r"""Generator G: match two meshes by optimal transport, warp the pose mesh, refine it under the identity.

    .. math:: T = \mathrm{Sinkhorn}(f(A), f(B)), \qquad W_i = \frac{\sum_j T_{ij} B_j}{\sum_j T_{ij}}, \qquad
              G(A, B) = S(W, f(A))

    for identity mesh A and pose mesh B, which may differ in vertex count and order. With the pointwise extractor of
    3D-CoreNet two further linear maps bring the features to the matching,
    :math:`T = \mathrm{Sinkhorn}(\theta f(A), \varphi f(B))`.

    Args:
        extractor: ``"setconv"`` (X-DualNet: :class:`~meshkit.nn.SetConvExtractor`) or ``"pointwise"`` (3D-CoreNet:
            :class:`~meshkit.models.PointwiseExtractor`, with theta and phi).
        extractor_widths: channels of the feature extractor.
        extractor_blocks: residual blocks of the pointwise extractor.
        k: neighbours in the set convolutions.
        descriptors: descriptor channels per vertex beside the coordinates (0: coordinates alone, as in the paper).
        widths: channels of the residual blocks.
        condition: what the residual blocks know of the identity. ``"features"``: the extractor's features, as in the
            paper. ``"descriptors"``: the descriptors alone, which do not change with the pose. Features contain the
            identity mesh's coordinates and with them its own pose; where that pose is the wanted one, as when dual
            reconstruction rebuilds B from B, the blocks can copy it, and never learn to transfer a shape.
        eps: entropic regularisation of the matching.
        n_iters: Sinkhorn iterations.
        norm: conditional norm of the blocks, ``"elain"`` or, for the paper's ablation, ``"spadain"``
            (:class:`~meshkit.norm.SPAdaIN`), which takes scale and shift from the condition alone.
        spectral: spectral normalisation in the blocks.
        residual: the output is the warped mesh plus a learned displacement.
        rigid_radius: if given, the warped mesh passes through
            :func:`~meshkit.deform.rigid_moving_least_squares` of this radius (in the unit of the meshes) before the
            blocks see it. A soft matching averages over all vertices that look alike, most of all those around a limb,
            and shrinks limbs to their axes; the identity mesh's own local form puts the flesh back.
        poisson_weight: if given, the warped mesh passes through :func:`~meshkit.deform.poisson_deform` of radius
            ``rigid_radius`` with this weight of the positions instead: the identity's limbs keep their lengths too.
        match_size: scale the pose mesh about the origin to the identity's size before warping it. Sizes are read from
            the last descriptor channel, which must be their logarithm, as
            :func:`~meshkit.descriptors.intrinsic_descriptors` has it. A warp alone gives the identity the limb lengths
            of the pose mesh's body.
        normalize_plan: warp with the row-normalised plan (released code). ``False`` warps with the raw plan as the
            paper prints it, whose rows sum to 1/N, so that the warped mesh is N times too small.
        symmetry: in evaluation, given ``identity_faces``, look at the identity mesh's mirror image too, and let
            :func:`~meshkit.models.mirror_labels` choose for each vertex which of the two it is matched as.
            Limbs that are exchanged by a mistaken matching are put right where they would be torn. Takes bodies
            whose left and right lie along x.
        released: the released code to the letter: its first convolution
            (:class:`~meshkit.models.OrderedPoseTransferStack`), and the 1e-8 that it adds to the denominators of the
            matching. For checkpoints of that code; see :func:`~meshkit.models.load_released_checkpoint`.

    Shape:
        ``identity (B, N, 3)``, ``pose (B, M, 3)``, masks ``(B, N)`` and ``(B, M)``, descriptors ``(B, N, D)`` and
        ``(B, M, D)``.

    Raises:
        ValueError: meshes are not (B, V, 3), batches differ, descriptors are missing, fewer than ``k`` vertices;
            options out of range, or ``n_iters`` and ``k`` that are no whole numbers.

    Reference:
        X-DualNet, "Network architecture"; sizes in the appendix.

    Example:
        >>> net = PoseTransferGenerator(extractor_widths=(8, 16), k=4, widths=(32, 16))
        >>> net(torch.randn(1, 30, 3), torch.randn(1, 40, 3)).vertices.shape
        torch.Size([1, 30, 3])
    """

    def __init__(
        self,
        *,
        extractor: str = "setconv",
        extractor_widths: Sequence[int] = (32, 64, 128),
        extractor_blocks: int = 4,
        k: int = 32,
        descriptors: int = 0,
        widths: Sequence[int] = (1024, 512, 256),
        eps: float = 0.03,
        n_iters: int = 5,
        norm: str = "elain",
        spectral: bool = True,
        residual: bool = False,
        condition: str = "features",
        rigid_radius: float | None = None,
        poisson_weight: float | None = None,
        match_size: bool = False,
        symmetry: bool = False,
        normalize_plan: bool = True,
        released: bool = False,
    ) -> None:
        super().__init__()
        if not eps > 0 or n_iters < 1 or k < 1:
            raise ValueError(f"eps, n_iters and k must be positive, got {eps}, {n_iters} and {k}")
        counts: tuple[Any, ...] = (n_iters, k)
        if not all(isinstance(count, Integral) for count in counts):  # 5.0 would be refused only in the forward pass
            raise ValueError(f"n_iters and k must be whole numbers, got {n_iters} and {k}")
        check_widths(widths)
        check_widths(extractor_widths, "extractor_widths")
        check_whole(descriptors, "descriptors", least=0)
        if extractor not in ("setconv", "pointwise"):
            raise ValueError(f'extractor must be "setconv" or "pointwise", got {extractor!r}')
        if condition not in ("features", "descriptors"):
            raise ValueError(f'condition must be "features" or "descriptors", got {condition!r}')
        if norm not in _NORMS:
            raise ValueError(f'norm must be "elain" or "spadain", got {norm!r}')
        if (condition == "descriptors" or match_size) and descriptors == 0:
            raise ValueError('condition="descriptors" and match_size need descriptors: give their number of channels')
        self.eps, self.n_iters, self.normalize_plan = eps, n_iters, normalize_plan
        if poisson_weight is not None and rigid_radius is None:
            raise ValueError("poisson_weight needs a rigid_radius")
        for name, value in (("rigid_radius", rigid_radius), ("poisson_weight", poisson_weight)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive or None, got {value}")
        self.condition, self.match_size = condition, match_size
        self.rigid_radius, self.poisson_weight = rigid_radius, poisson_weight
        self.symmetry = symmetry
        features = extractor_widths[-1]
        self.extractor: SetConvExtractor | PointwiseExtractor
        if extractor == "setconv":
            self.extractor = SetConvExtractor(extractor_widths, k=k, descriptors=descriptors)
            self.theta: nn.Module = nn.Identity()
            self.phi: nn.Module = nn.Identity()
        else:
            self.extractor = PointwiseExtractor(extractor_widths, blocks=extractor_blocks, descriptors=descriptors)
            self.theta, self.phi = nn.Linear(features, features), nn.Linear(features, features)
        stack = OrderedPoseTransferStack if released else PoseTransferStack
        self.released = released
        cond_features = features if condition == "features" else descriptors
        self.transfer = stack(cond_features, widths, norm=_NORMS[norm], spectral=spectral, residual=residual)
        self.register_buffer("descriptor_mean", torch.zeros(descriptors))
        self.register_buffer("descriptor_std", torch.ones(descriptors))
        self._initialize()

    descriptor_mean: Tensor
    descriptor_std: Tensor

    # Not reset_parameters: it draws what a fresh network's parts leave to it, and leaves the rest as it is.
    def _initialize(self) -> None:
        """Xavier initialisation, with a last layer small enough that training starts from a mesh near the centre."""
        for module in self.modules():
            # Spectral normalisation fixes the scale of the maps it wraps, so theirs does not matter.
            if isinstance(module, nn.Linear) and not is_parametrized(module):
                nn.init.xavier_normal_(module.weight)
        # At gain 1 the first outputs are metres away from any body and hundreds of steps go into bringing them back.
        nn.init.normal_(self.transfer.narrow[-1].get_parameter("weight"), std=1e-3)
        nn.init.zeros_(self.transfer.narrow[-1].get_parameter("bias"))

    def extra_repr(self) -> str:
        """Options in the printed module; sizes are those of its parts."""
        matching = settings(self, "eps", "n_iters", "normalize_plan", "released")
        return f"{matching}, {settings(self, 'condition', 'rigid_radius', 'poisson_weight', 'match_size', 'symmetry')}"

    @torch.no_grad()
    def fit_descriptors(self, descriptors: Tensor, *, mask: Tensor | None = None) -> None:
        """Take mean and deviation of the training set's descriptors ``(..., D)``; inputs are standardised by them.

        Args:
            descriptors: of all vertices of the training set.
            mask: ``(...)`` bool, True = real vertex; rows of padding do not count.

        Raises:
            ValueError: another number of channels than the model's, another shape of the mask, or fewer than two rows.
        """
        if descriptors.shape[1:][-1:] != self.descriptor_mean.shape:
            raise ValueError(self._other_channels(descriptors))
        if mask is not None and (mask.dtype != torch.bool or mask.shape != descriptors.shape[:-1]):
            raise ValueError(f"mask must be bool {tuple(descriptors.shape[:-1])}, got {mask.dtype} {tuple(mask.shape)}")
        flat = descriptors.flatten(0, -2) if mask is None else descriptors[mask]
        if len(flat) < 2:
            raise ValueError(f"a deviation needs the descriptors of two vertices or more, got {len(flat)}")
        self.descriptor_mean.copy_(flat.mean(0))
        self.descriptor_std.copy_(flat.std(0).clamp_min(1e-6))

    def encode(self, verts: Tensor, *, mask: Tensor | None = None, descriptors: Tensor | None = None) -> Tensor:
        """Features ``(B, N, D)`` of meshes ``(B, N, 3)``; pass them to :meth:`forward` when one mesh serves twice."""
        if verts.dim() != 3 or verts.shape[2] != 3:
            raise ValueError(f"a mesh batch must have shape (B, V, 3), got {tuple(verts.shape)}")
        if descriptors is not None:
            descriptors = self._standardise(descriptors)
        return self.extractor(verts, descriptors=descriptors, mask=mask)

    def _standardise(self, descriptors: Tensor) -> Tensor:
        if descriptors.shape[2:] != self.descriptor_mean.shape:
            raise ValueError(self._other_channels(descriptors))
        # Signatures have long tails where a mesh has spikes; four deviations hold all that is signal.
        return ((descriptors - self.descriptor_mean) / self.descriptor_std).clamp(-4, 4)

    def _other_channels(self, descriptors: Tensor) -> str:
        return f"this model takes {len(self.descriptor_mean)} descriptor channels, got {tuple(descriptors.shape)}"

    def match(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
    ) -> TransportPlan | DensePlan:
        """The plan between the features ``(B, N, D)`` and ``(B, M, D)`` of two meshes, which :meth:`encode` gives."""
        pair = (self.theta(identity), self.phi(pose))
        options: dict[str, Any] = {"eps": self.eps, "n_iters": self.n_iters}
        options |= {"mask_x": identity_mask, "mask_y": pose_mask}
        if not self.released:
            return sinkhorn(*pair, **options)
        # X-DualNet's code adds the constant once more where it normalises the rows; 3D-CoreNet's does not.
        floor = STABILIZER if isinstance(self.extractor, SetConvExtractor) else 0.0
        return stabilized_matching(*pair, **options, floor=floor)

    def _warp(
        self, identity: Tensor, pose: Tensor, positions: Tensor, identity_mask: Tensor | None, pose_mask: Tensor | None
    ) -> tuple[TransportPlan | DensePlan, Tensor]:
        """The plan between two meshes' features, and the pose mesh's positions carried by it."""
        plan = self.match(identity, pose, identity_mask=identity_mask, pose_mask=pose_mask)
        values = positions.to(plan.dtype)
        return plan, plan.barycentric(values) if self.normalize_plan else plan @ values

    def _handed(
        self,
        verts: Tensor,
        faces: Tensor,
        descriptors: Tensor | None,
        features: Tensor,
        *pair: Any,
    ) -> Tensor:
        """Features of the identity mesh, of its mirror image where that is what a vertex is better matched as."""
        mask: Tensor | None = pair[2]
        # An identity beside several poses comes as one mesh, expanded: its mirror image is one too.
        once = all(x is None or x.stride(0) == 0 for x in (verts, features, mask, descriptors))
        first = slice(0, 1) if once else slice(None)
        one, own = verts[first], features[first]
        mask, known = (None if x is None else x[first] for x in (mask, descriptors))
        mirrored = self.encode(one * one.new_tensor([-1.0, 1.0, 1.0]), mask=mask, descriptors=known)
        with torch.no_grad():  # which sides correspond is a choice, without a derivative
            partners = self.match(mirrored, own, identity_mask=mask, pose_mask=mask).argmax()
        mirrored, partners = (x.expand(len(verts), *x.shape[1:]) for x in (mirrored, partners))
        labels = self._labels(verts, faces, features, mirrored, partners, *pair)
        return torch.where(labels[..., None], mirrored, features)

    @torch.no_grad()
    def _labels(
        self, verts: Tensor, faces: Tensor, features: Tensor, mirrored: Tensor, partners: Tensor, *pair: Any
    ) -> Tensor:
        mask = pair[2]
        targets, others = (self._warp(f, *pair)[1] for f in (features, mirrored))
        labels = []
        for b in range(len(verts)):
            real = slice(None) if mask is None else mask[b].nonzero()[:, 0]
            own = faces if faces.dim() == 2 else faces[b]
            mesh = [verts[b, real], own[(own >= 0).all(1)], targets[b, real], others[b, real], partners[b, real]]
            if mask is not None:
                place = mask[b].cumsum(0) - 1
                mesh[1], mesh[4] = place[mesh[1]], place[mesh[4]]
            labels.append(torch.zeros(verts.shape[1], dtype=torch.bool, device=verts.device))
            labels[-1][real] = mirror_labels(*mesh)
        return torch.stack(labels)

    def _flesh_out(self, identity: Tensor, warped: Tensor, mask: Tensor | None, features: Tensor | None) -> Tensor:
        options: dict[str, Any] = {"radius": self.rigid_radius, "mask": mask, "features": features}
        if self.poisson_weight is None:
            return rigid_moving_least_squares(identity, warped, **options)
        return poisson_deform(identity, warped, weight=self.poisson_weight, **options)

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
        identity_features: Tensor | None = None,
        pose_features: Tensor | None = None,
        identity_faces: Tensor | None = None,
    ) -> GeneratorOutput:
        """Give the identity mesh the pose of the pose mesh; features are computed unless given.

        ``identity_faces``, ``(F, 3)`` or ``(B, F, 3)`` padded with -1, are looked at if the model has ``symmetry``, in
        evaluation.

        With ``condition="descriptors"``, ``identity_descriptors`` are needed even beside given features.
        """
        if len(identity) != len(pose):
            raise ValueError(f"identity and pose batches differ: {tuple(identity.shape)} and {tuple(pose.shape)}")
        if identity_features is None:
            identity_features = self.encode(identity, mask=identity_mask, descriptors=identity_descriptors)
        if pose_features is None:
            pose_features = self.encode(pose, mask=pose_mask, descriptors=pose_descriptors)
        if pose_mask is not None:
            pose = pose.masked_fill(~pose_mask[..., None], 0.0)
        if self.match_size:
            if identity_descriptors is None or pose_descriptors is None:
                raise ValueError("match_size needs identity_descriptors and pose_descriptors, also beside features")
            growth = masked_mean(identity_descriptors[..., -1:], identity_mask) - masked_mean(
                pose_descriptors[..., -1:], pose_mask
            )
            pose = pose * growth.exp()[:, None]
        pair = (identity_features, pose_features, pose, identity_mask, pose_mask)
        if self.symmetry and not self.training and identity_faces is not None:
            pair = (self._handed(identity, identity_faces, identity_descriptors, *pair), *pair[1:])
        plan, warped = self._warp(*pair)
        standard = None if identity_descriptors is None else self._standardise(identity_descriptors)
        if self.condition == "descriptors" and standard is None:
            raise ValueError('condition="descriptors" needs identity_descriptors, also beside identity_features')
        condition = standard if self.condition == "descriptors" else identity_features
        start = warped.to(identity.dtype)
        if self.rigid_radius is not None:
            start = self._flesh_out(identity, start, identity_mask, standard)
        vertices = self.transfer(start, condition, mask=identity_mask)
        if identity_mask is not None:
            vertices = vertices.masked_fill(~identity_mask[..., None], 0.0)
        return GeneratorOutput(vertices, warped, plan)
