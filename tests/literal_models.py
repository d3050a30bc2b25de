"""The released networks, written out: names and shapes of their checkpoints, and their forward passes on those names.

Slow, one sample at a time, no shared code with the package. A checkpoint is a dict of tensors under the names the
authors' files have; ``forward`` functions take such dicts and a pair of meshes ``(N, 3)``, ``(M, 3)``.
"""

import torch
from torch import Tensor
from torch.nn.functional import conv1d, leaky_relu, normalize

State = dict[str, Tensor]
Shapes = dict[str, tuple[int, ...]]


# Names and shapes


def conv_shapes(name: str, fin: int, fout: int, *kernel: int, bias: bool = True) -> Shapes:
    return {f"{name}.weight": (fout, fin, *(kernel or (1,)))} | ({f"{name}.bias": (fout,)} if bias else {})


def spectral_shapes(name: str, fin: int, fout: int, *, bias: bool = True) -> Shapes:
    shapes: Shapes = {f"{name}.bias": (fout,)} if bias else {}
    return shapes | {
        f"{name}.weight_orig": (fout, fin, 1),
        f"{name}.weight_u": (fout,),
        f"{name}.weight_v": (fin,),
    }


def pose_transfer_shapes(cond: int) -> Shapes:
    """net_G of X-DualNet (condition of 128 channels) and of 3D-CoreNet (256)."""
    shapes = conv_shapes("fc", 3, 1024, 3)
    for i, (fin, fout) in enumerate([(1024, 1024), (1024, 512), (512, 256), (256, 3)]):
        shapes |= conv_shapes(f"conv{i + 1}", fin, fout)
    for i, width in enumerate((1024, 512, 256)):
        block = f"elain_block{i + 1}"
        for name in "01s":
            shapes |= spectral_shapes(f"{block}.conv_{name}", width, width, bias=name != "s")
            norm = f"{block}.norm_{name}"
            shapes |= conv_shapes(f"{norm}.mlp_same", cond, width)
            shapes |= conv_shapes(f"{norm}.mlp_gamma", width, width) | conv_shapes(f"{norm}.mlp_beta", width, width)
            shapes |= conv_shapes(f"{norm}.mlp_weight", 2 * width, width)
    return shapes


def setconv_shapes() -> Shapes:
    """net_Corr of X-DualNet."""
    shapes: Shapes = {}
    for i, (fin, fout) in enumerate([(3, 32), (32, 64), (64, 128)]):
        name = f"feat_conv{i + 1}"
        for layer, channels in enumerate((fin + 3, fout, fout)):
            shapes |= conv_shapes(f"{name}.fc{layer + 1}", channels, fout, 1, 1, bias=False)
            shapes |= {f"{name}.bn{layer + 1}.weight": (fout,), f"{name}.bn{layer + 1}.bias": (fout,)}
    return shapes


def pointwise_shapes() -> Shapes:
    """net_Corr of 3D-CoreNet."""
    shapes: Shapes = {}
    for i, (fin, fout) in enumerate([(3, 64), (64, 128), (128, 256)]):
        shapes |= conv_shapes(f"adaptive_feature.layer{i + 1}", fin, fout)
    for i in range(4):
        shapes |= conv_shapes(f"layer.{i}.conv1", 256, 256) | conv_shapes(f"layer.{i}.conv2", 256, 256)
        shapes |= {f"layer.{i}.prelu.weight": (1,)}
    return shapes | conv_shapes("phi", 256, 256) | conv_shapes("theta", 256, 256)


def npt_shapes() -> Shapes:
    """NPT, either variant."""
    shapes: Shapes = {}
    for i, (fin, fout) in enumerate([(3, 64), (64, 128), (128, 1024)]):
        shapes |= conv_shapes(f"encoder.conv{i + 1}", fin, fout)
    for i, (fin, fout) in enumerate([(1027, 1027), (1027, 513), (513, 256), (256, 3)]):
        shapes |= conv_shapes(f"decoder.conv{i + 1}", fin, fout)
    for i, width in enumerate((1027, 513, 256)):
        block = f"decoder.spadain_block{i + 1}"
        for norm in ("spadain1", "spadain2", "spadain_res"):
            shapes |= conv_shapes(f"{block}.{norm}.conv_weight", 3, width)
            shapes |= conv_shapes(f"{block}.{norm}.conv_bias", 3, width)
        for conv in ("conv1", "conv2", "conv_res"):
            shapes |= conv_shapes(f"{block}.{conv}", width, width)
    return shapes


def random_state(shapes: Shapes, seed: int) -> State:
    """Weights of a scale that keeps activations near one, with spectral vectors as training would leave them."""
    generator = torch.Generator().manual_seed(seed)
    state: State = {}
    for name, shape in shapes.items():
        value = torch.randn(shape, generator=generator)
        if name.endswith(".weight_v"):
            weight = state[name.replace("_v", "_orig")].flatten(1)
            for _ in range(5):
                value = normalize(weight.T @ normalize(weight @ value, dim=0), dim=0)
            state[name], state[name.replace("_v", "_u")] = value, normalize(weight @ value, dim=0)
        elif ".bn" in name or "prelu" in name:
            state[name] = 0.3 * value + (1.0 if name.endswith("weight") else 0.0)
        elif len(shape) == 1:
            state[name] = 0.1 * value
        else:
            # Small in the norms, whose chaos would amplify rounding, and at the end, where tanh would saturate.
            scale = 0.2 if "mlp" in name or name.endswith("conv4.weight") else 1.0
            state[name] = scale * value / value[0].numel() ** 0.5
    return state


# Forward passes


def conv(p: State, name: str, x: Tensor) -> Tensor:
    """Convolution of kernel 1 on rows of ``x (..., C)``, spectrally normalised where the checkpoint has its vectors."""
    if f"{name}.weight_orig" in p:
        weight = p[f"{name}.weight_orig"].flatten(1)
        weight = weight / (p[f"{name}.weight_u"] @ weight @ p[f"{name}.weight_v"])
    else:
        weight = p[f"{name}.weight"].flatten(1)
    result = x @ weight.T
    return result + p[f"{name}.bias"] if f"{name}.bias" in p else result


def instance_norm(x: Tensor) -> Tensor:
    """Over all dimensions but the last."""
    dims = tuple(range(x.dim() - 1))
    return (x - x.mean(dims)) / (x.var(dims, unbiased=False) + 1e-5).sqrt()


def setconv_features(p: State, points: Tensor) -> Tensor:
    nearest = (points[:, None] - points).square().sum(2).argsort(1)[:, :32]
    relative = points[nearest] - points[:, None]
    x = points
    for i in (1, 2, 3):
        h = torch.cat([x[nearest], relative], 2)
        for layer in (1, 2, 3):
            norm = f"feat_conv{i}.bn{layer}"
            h = instance_norm(conv(p, f"feat_conv{i}.fc{layer}", h)) * p[f"{norm}.weight"] + p[f"{norm}.bias"]
            h = leaky_relu(h, 0.1)
        x = h.amax(1)
    return x


def pointwise_features(p: State, points: Tensor) -> Tensor:
    x = instance_norm(conv(p, "adaptive_feature.layer1", points))
    x = instance_norm(conv(p, "adaptive_feature.layer2", leaky_relu(x, 0.2)))
    x = instance_norm(conv(p, "adaptive_feature.layer3", leaky_relu(x, 0.2)))
    x = x / x.norm(dim=1, keepdim=True)
    for i in range(4):
        slope = p[f"layer.{i}.prelu.weight"]
        h = instance_norm(conv(p, f"layer.{i}.conv1", x))
        h = torch.where(h > 0, h, slope * h)
        x = x + instance_norm(conv(p, f"layer.{i}.conv2", h))
        x = torch.where(x > 0, x, slope * x)
    return x


def matching(theta: Tensor, phi: Tensor, stabilizer: float = 1e-8) -> Tensor:
    """The plan after five iterations, with the released code's constant in the denominators."""
    n, m = len(theta), len(phi)
    kernel = torch.exp(-(1 - normalize(theta, dim=1) @ normalize(phi, dim=1).T) / 0.03)
    a = torch.full((n,), 1 / n, dtype=kernel.dtype)
    for _ in range(5):
        b = 1 / m / (kernel.T @ a + stabilizer)
        a = 1 / n / (kernel @ b + stabilizer)
    return a[:, None] * kernel * b


def elain(p: State, name: str, x: Tensor, cond: Tensor) -> Tensor:
    aligned = conv(p, f"{name}.mlp_same", cond)
    gamma, beta = conv(p, f"{name}.mlp_gamma", aligned), conv(p, f"{name}.mlp_beta", aligned)
    mean, std = x.mean(0), (x.var(0) + 1e-5).sqrt()
    weight = conv(p, f"{name}.mlp_weight", torch.cat([aligned.mean(0), mean]))
    gamma = weight * gamma + (1 - weight) * std
    beta = weight * beta + (1 - weight) * mean
    return (1 + gamma) * (x - mean) / std + beta


def elain_block(p: State, name: str, x: Tensor, cond: Tensor) -> Tensor:
    def branch(which: str, h: Tensor) -> Tensor:
        return conv(p, f"{name}.conv_{which}", leaky_relu(elain(p, f"{name}.norm_{which}", h, cond), 0.2))

    return branch("s", x) + branch("1", branch("0", x))


def pose_transfer(p: State, warped: Tensor, cond: Tensor) -> Tensor:
    x = conv1d(warped.T[None], p["fc.weight"], p["fc.bias"], padding=1)[0].T
    x = elain_block(p, "elain_block1", conv(p, "conv1", x), cond)
    x = elain_block(p, "elain_block2", conv(p, "conv2", x), cond)
    x = elain_block(p, "elain_block3", conv(p, "conv3", x), cond)
    return 2 * torch.tanh(conv(p, "conv4", x))


def xdualnet_forward(net_g: State, net_corr: State, identity: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices and warped mesh."""
    features = setconv_features(net_corr, identity)
    plan = matching(features, setconv_features(net_corr, pose))
    warped = plan @ pose / (plan.sum(1, keepdim=True) + 1e-8)
    return pose_transfer(net_g, warped, features), warped


def corenet3d_forward(net_g: State, net_corr: State, identity: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices and warped mesh."""
    features = pointwise_features(net_corr, identity)
    phi = conv(net_corr, "phi", pointwise_features(net_corr, pose))
    plan = matching(conv(net_corr, "theta", features), phi)
    warped = plan @ pose / plan.sum(1, keepdim=True)
    return pose_transfer(net_g, warped, features), warped


def npt_forward(p: State, identity: Tensor, pose: Tensor, *, max_pool: bool) -> Tensor:
    """Vertices."""
    h = pose
    for i in (1, 2, 3):
        h = instance_norm(conv(p, f"encoder.conv{i}", h)).relu()
    if max_pool:
        h = h.amax(0).expand(len(identity), -1)
    x = torch.cat([h, identity], 1)
    for i in (1, 2, 3):
        x = conv(p, f"decoder.conv{i}", x)
        block = f"decoder.spadain_block{i}"

        # The first block of the max-pool variant modulates without normalising.
        def branch(norm: str, which: str, h: Tensor, block: str = block, bare: bool = max_pool and i == 1) -> Tensor:
            weight, bias = (conv(p, f"{block}.{norm}.conv_{kind}", identity) for kind in ("weight", "bias"))
            return conv(p, f"{block}.{which}", (weight * (h if bare else instance_norm(h)) + bias).relu())

        x = branch("spadain2", "conv2", branch("spadain1", "conv1", x)) + branch("spadain_res", "conv_res", x)
    return 2 * torch.tanh(conv(p, "decoder.conv4", x))
