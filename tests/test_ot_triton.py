"""The Triton kernels against blocks of torch operations in float64: in Triton's interpreter, and on a GPU if there is.

The interpreter must be chosen before Triton is imported, so the tests run in a process of their own.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import assert_near, rand, scattered_mask
from literal_ot import one_by_one  # noqa: F401
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from meshkit.ot import sinkhorn
from meshkit.ot import tiles as tiles_module
from meshkit.ot.tiles import Factors, FeatureTiles, Reference, feature_tiles

pytest.importorskip("triton", reason="Triton is not installed")
# NumPy, which interprets, reports the logarithm of 0 and sums with NaN, both of which are meant.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


def test_kernels_in_the_interpreter() -> None:
    """All tests of this file that need kernels to run."""
    if INTERPRETED:
        pytest.skip("this is the process with the interpreter")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__],
        env=environment | {"TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": ""},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize(
    ("kernel", "constants"),
    [
        ("_log_sums", {}),
        ("_products", {"RANK": 0, "WIDTH": 1, "c": 1}),
        ("_products", {"RANK": 16, "WIDTH": 16}),
    ],
)
def test_kernels_compile(kernel, constants, capability, tmp_path, monkeypatch):
    """To machine code, for which Triton needs no GPU; it refuses much that its interpreter lets pass."""
    if INTERPRETED:
        pytest.skip("the interpreter replaces the compiler")
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from meshkit.ot import _triton_tiles

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    function = getattr(_triton_tiles, kernel)
    constants = {"ROWS": 16, "COLUMNS": 16, "DEPTH": 16, "PRECISION": "tf32", **constants}
    kinds = {"scale": "fp32"} | dict.fromkeys(["n", "m", "d", "c", "rank", "span"], "i32")
    signature = {name: "constexpr" if name in constants else kinds.get(name, "*fp32") for name in function.arg_names}
    source = ASTSource(function, signature, constexprs=constants)
    assert triton.compile(source, target=GPUTarget("cuda", capability, 32)).asm["cubin"]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("MESHKIT_TRITON", "1")
    if INTERPRETED:
        return "cpu"
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device; test_kernels_in_the_interpreter runs this")
    return "cuda"


def problem(n: int, m: int, d: int, c: int, device: str) -> tuple[FeatureTiles, FeatureTiles, list[Tensor]]:
    """Kernels, torch operations in float64, and potentials and columns of both sides."""
    x, y, *rest = (
        t.float().to(device)
        for t in (
            rand(n, d),
            rand(m, d, seed=1),
            rand(n, seed=2),
            rand(m, seed=3),
            rand(n, c, seed=4),
            rand(m, c, seed=5),
        )
    )
    tiles = feature_tiles(x, y, "none")
    assert type(tiles).__name__ == "TritonTiles"
    assert tiles.log_only
    return tiles, FeatureTiles(x.double(), y.double(), "none"), rest


def doubled(value: Reference | None) -> Reference | None:
    return None if value is None else Reference(value.alpha.double(), value.beta.double(), value.scale)


SHAPES = pytest.mark.parametrize(
    ("n", "m", "d", "c"), [(70, 90, 24, 3), (64, 128, 32, 1), (1, 75, 8, 4), (66, 1, 70, 17), (5, 40, 130, 129)]
)


@SHAPES
def test_products(n, m, d, c, device):
    tiles, truth, (alpha, beta, rows, columns) = problem(n, m, d, c, device)
    for reference in (Reference(alpha, beta, 0.3), None if d < 30 else Reference(alpha, beta, -0.5)):
        expected = truth.apply(columns.double(), doubled(reference))
        assert_near(tiles.apply(columns, reference), expected, 3e-6)
        expected = truth.apply_transpose(rows.double(), doubled(reference))
        assert_near(tiles.apply_transpose(rows, reference), expected, 3e-6)


def test_products_of_strided_columns(device):
    tiles, truth, (_, _, rows, columns) = problem(20, 30, 8, 6, device)
    assert_near(tiles.apply(columns[:, ::2]), truth.apply(columns[:, ::2].double()), 3e-6)
    assert_near(tiles.apply_transpose(rows.mT.contiguous().mT), truth.apply_transpose(rows.double()), 3e-6)


@SHAPES
def test_logarithms_of_sums(n, m, d, c, device):
    tiles, truth, (alpha, beta, *_) = problem(n, m, d, c, device)
    assert_near(tiles.log_sum_rows(beta, 0.7), truth.log_sum_rows(beta.double(), 0.7), 1e-6)
    assert_near(tiles.log_sum_columns(alpha, 0.7), truth.log_sum_columns(alpha.double(), 0.7), 1e-6)
    some = torch.arange(0, m, 3, device=device)
    expected = truth.log_sum_columns(alpha.double(), 1.0, some)
    assert_near(tiles.log_sum_columns(alpha, 1.0, some), expected, 1e-6)


def test_logarithms_of_sums_at_the_ends_of_the_range(device):
    tiles, truth, (_, beta, *_) = problem(33, 70, 8, 1, device)
    wide = 1e4 * beta
    assert_near(tiles.log_sum_rows(wide, 100.0), truth.log_sum_rows(wide.double(), 100.0), 1e-6)
    nothing = torch.full_like(beta, -torch.inf)
    assert bool((tiles.log_sum_rows(nothing) == -torch.inf).all())
    nothing[:69] = -torch.inf
    nothing[69] = 0.0
    assert_near(tiles.log_sum_rows(nothing), truth.logits(slice(None))[:, 69], 1e-6)


def test_starved_columns_have_sums_of_their_own(device):
    """A column that every row shuns by far more than the range of float32."""
    x, y = torch.eye(40, 8, device=device) * 1e3, torch.eye(6, 8, device=device)
    y[5] = -10.0
    tiles, truth = feature_tiles(x, y, "none"), FeatureTiles(x.double(), y.double(), "none")
    beta, log_mu = torch.zeros(6, device=device), torch.full((40,), -5.3, device=device)
    expected = truth.log_sweep(beta.double(), log_mu.double(), 1.0, 1.0)
    for value, sums in zip(tiles.log_sweep(beta, log_mu, 1.0, 1.0), expected, strict=True):
        assert_near(value, sums, 1e-6)


@SHAPES
def test_pullback(n, m, d, c, device):
    """Contributions under one reference, one near it, one at another scale and one far away make three groups."""
    tiles, truth, (alpha, beta, rows, columns) = problem(n, m, d, c, device)
    references = [
        Reference(alpha, beta, 0.3),
        Reference(alpha + 1, beta - 2, 0.3),
        Reference(alpha, beta, -0.1),
        Reference(alpha - 60, beta, 0.3),
    ]
    factors = [Factors(rows, columns, reference) for reference in references]
    factors += [Factors(rows[:, :1], columns[:, -1:], None)] if d < 30 else []
    expected = truth.pullback([Factors(f.left.double(), f.right.double(), doubled(f.reference)) for f in factors])
    for gradient, exact in zip(tiles.pullback(factors), expected, strict=True):
        assert_near(gradient, exact, 5e-6)


@pytest.mark.parametrize("programs", [1, 1000])
def test_partial_results_of_programs_are_joined(programs, device, monkeypatch):
    from meshkit.ot import _triton_tiles

    monkeypatch.setattr(_triton_tiles, "_PROGRAMS", programs)
    tiles, truth, (_, beta, rows, columns) = problem(30, 300, 8, 3, device)
    assert_near(tiles.log_sum_rows(beta), truth.log_sum_rows(beta.double()), 1e-6)
    assert_near(tiles.apply(columns), truth.apply(columns.double()), 3e-6)
    factors = [Factors(rows, columns, None)]
    expected = truth.pullback([Factors(rows.double(), columns.double(), None)])
    for gradient, exact in zip(tiles.pullback(factors), expected, strict=True):
        assert_near(gradient, exact, 5e-6)


@pytest.mark.parametrize("rows", [1, 64, 6890, 10**6])
@pytest.mark.parametrize("columns", [1, 64, 65, 1000, 6890])
def test_spans_cover_all_columns_and_none_is_empty(rows, columns):
    from meshkit.ot._triton_tiles import divide

    splits, span = divide(rows, columns, torch.device("cpu"))
    assert (splits - 1) * span < columns <= splits * span
    assert span % 64 == 0


def warp_and_gradients(
    fx: Tensor, fy: Tensor, values: Tensor, upstream: Tensor, **options: Any
) -> tuple[list[Tensor], type]:
    """The warp, the gradients of everything, and what computed them."""
    inputs = [t.detach().clone().requires_grad_() for t in (fx, fy, values)]
    plan = sinkhorn(*inputs[:2], **options)
    warped = plan.barycentric(inputs[2])
    used = type(plan._samples[0].kernel.tiles)
    return [warped.detach(), *torch.autograd.grad(warped, inputs, upstream)], used


LAYERS: dict[str, tuple[tuple[int, int], dict[str, Any]]] = {
    "cosine": ((70, 45), {"n_iters": 3}),
    "more columns": ((40, 90), {"n_iters": 2}),
    "one row": ((1, 9), {"n_iters": 2}),
    "one column": ((9, 1), {"n_iters": 2}),
    "squared distances": ((30, 20), {"cost": "sqeuclidean", "eps": 1.0, "n_iters": 2}),
    "unbalanced": ((30, 20), {"reach": 0.5, "n_iters": 2}),
    "unbalanced on one side": ((30, 20), {"reach": (None, 0.1), "n_iters": 2}),
    "annealed": ((30, 20), {"eps": [0.5, 0.1, 0.03], "n_iters": 3}),
    "implicit": ((30, 20), {"grad": "implicit", "eps": 1.0, "n_iters": 6}),
    "last step": ((30, 20), {"grad": "last_step", "n_iters": 3}),
    "until converged": ((30, 20), {"tol": 1e-3, "n_iters": 20, "eps": 0.3}),
}


@pytest.mark.parametrize("name", LAYERS)
def test_layer_equals_the_torch_operations(name, device):
    """Values and gradients against float64, within 1e-5."""
    (n, m), options = LAYERS[name]
    data = [rand(1, n, 12), rand(1, m, 12, seed=1), rand(1, m, 3, seed=2), rand(1, n, 3, seed=3)]
    expected, _ = warp_and_gradients(*data, **options)
    results, used = warp_and_gradients(*(t.float().to(device) for t in data), **options)
    assert used.__name__ == "TritonTiles"
    for result, exact in zip(results, expected, strict=True):
        assert_near(result.cpu(), exact, 1e-5, scale=max(exact.abs().amax().item(), 1.0))


@pytest.mark.parametrize("eps", [1e-3, 1e-2])
def test_small_eps(eps, device):
    """Most columns are starved. Logits of size 1 / eps round to eps(float32) / eps, in torch as well."""
    data = [rand(1, 50, 6), rand(1, 60, 6, seed=1), rand(1, 60, 3, seed=2), rand(1, 50, 3, seed=3)]
    expected, _ = warp_and_gradients(*data, eps=eps, n_iters=3)
    results, _ = warp_and_gradients(*(t.float().to(device) for t in data), eps=eps, n_iters=3)
    for result, exact in zip(results, expected, strict=True):
        assert_near(result.cpu(), exact, 5e-7 / eps)


def test_padding_has_no_effect(device):
    """Batch of two with masks and NaN in the padding; the second sample is one real row."""
    mask_x, mask_y = scattered_mask([30, 1], 40), scattered_mask([20, 25], 33, seed=1)
    fx, fy = rand(2, 40, 8), rand(2, 33, 8, seed=1)
    fx[~mask_x], fy[~mask_y] = torch.nan, torch.nan
    values, upstream = rand(2, 33, 3, seed=2), rand(2, 40, 3, seed=3)
    data = [fx, fy, values, upstream]
    expected, _ = warp_and_gradients(*data, mask_x=mask_x, mask_y=mask_y, n_iters=2)
    masks = {"mask_x": mask_x.to(device), "mask_y": mask_y.to(device)}
    results, used = warp_and_gradients(*(t.float().to(device) for t in data), **masks, n_iters=2)
    assert used.__name__ == "TritonTiles"
    for result, exact in zip(results, expected, strict=True):
        assert_near(result.cpu(), exact, 1e-5)


def test_nan_spoils_its_own_sample_alone(device):
    fx, fy = rand(2, 20, 8, dtype=torch.float32).to(device), rand(2, 15, 8, seed=1, dtype=torch.float32).to(device)
    fx[0, 3] = torch.nan
    plan = sinkhorn(fx, fy, n_iters=2)
    rows, columns = plan.marginals()
    assert bool(rows[0].isnan().all() & columns[0].isnan().all())
    assert bool(rows[1].isfinite().all() & columns[1].isfinite().all())


def test_sample_without_real_vertices_is_left_to_torch(device):
    fx, fy = rand(1, 5, 4, dtype=torch.float32).to(device), rand(1, 6, 4, dtype=torch.float32).to(device)
    plan = sinkhorn(fx, fy, mask_x=torch.zeros(1, 5, dtype=torch.bool, device=device))
    assert plan.row_sums().tolist() == [[0.0] * 5]


def test_kernels_serve_float32_features_alone(device, monkeypatch):
    x = rand(4, 3).to(device)
    assert type(feature_tiles(x, x, "none")) is FeatureTiles
    assert type(feature_tiles(x.float(), x.float(), "kernel")).__name__ == "TritonTiles"
    monkeypatch.setenv("MESHKIT_TRITON", "0")
    assert type(feature_tiles(x.float(), x.float(), "none")) is FeatureTiles
    assert feature_tiles(x.float(), x.float(), "logits").store == "logits"


def test_features_on_the_cpu_are_left_to_torch(monkeypatch):
    monkeypatch.delenv("MESHKIT_TRITON", raising=False)
    x = rand(4, 3, dtype=torch.float32)
    assert type(feature_tiles(x, x, "none")) is FeatureTiles


def test_nothing_fails_without_triton(device, monkeypatch):
    monkeypatch.setattr(tiles_module.importlib.util, "find_spec", lambda name: None)
    x = rand(4, 3, dtype=torch.float32).to(device)
    assert type(feature_tiles(x, x, "none")) is FeatureTiles


@pytest.mark.parametrize(("setting", "expected"), [("highest", "ieee"), ("high", "tf32")])
def test_precision_follows_torch(setting, expected):
    from meshkit.ot._triton_tiles import matmul_precision

    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision(setting)
        assert matmul_precision() == expected
    finally:
        torch.set_float32_matmul_precision(before)


class LargestTensor(TorchDispatchMode):
    """Numbers in the largest tensor that any operation returns."""

    def __init__(self) -> None:
        super().__init__()
        self.numel = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        sizes = [t.numel() for t in (result if isinstance(result, tuple | list) else [result]) if isinstance(t, Tensor)]
        self.numel = max(self.numel, *sizes, 0)
        return result


def test_no_operation_returns_a_matrix(device):
    data = [rand(1, 66, 5), rand(1, 90, 5, seed=1), rand(1, 90, 3, seed=2), rand(1, 66, 3, seed=3)]
    with LargestTensor() as largest:
        _, used = warp_and_gradients(*(t.float().to(device) for t in data), n_iters=2)
    assert used.__name__ == "TritonTiles"
    assert 66 * 5 <= largest.numel < 66 * 90  # the interpreter counts bytes


def test_memory_and_accuracy_at_full_size(device):
    """Forward and backward at 8192 x 8192, whose plan would take 268 MB; and the result in float64."""
    if device == "cpu":
        pytest.skip("memory is measured on a GPU")
    data = [rand(1, 8192, 32), rand(1, 8192, 32, seed=1), rand(1, 8192, 3, seed=2), rand(1, 8192, 3, seed=3)]
    inputs = [t.float().to(device) for t in data]
    warp_and_gradients(*inputs)
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    results, _ = warp_and_gradients(*inputs)
    assert torch.cuda.max_memory_allocated() - before < 80 << 20
    expected, _ = warp_and_gradients(*(t.to(device) for t in data), store="stream")
    for result, exact in zip(results, expected, strict=True):
        assert_near(result, exact, 1e-5)
