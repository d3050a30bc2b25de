"""Settings that all training recipes share, and the command line they are read from. The comments give the paper's."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeVar

import tyro
from _command_line import read

from meshkit.models import GeneratorConfig

Preset = Literal["tiny", "small", "paper"]
"""tiny: minutes on a CPU; small: hours on a CPU or minutes on a GPU; paper: the printed sizes and schedule."""


@dataclass(frozen=True)
class Settings:
    """What a run depends on besides its losses. The values are those of the preset; comments give the paper's."""

    ground_truth: ClassVar[bool] = True
    """Whether training looks at the ground truth; without, it need not be made."""

    preset: Preset = "tiny"
    """tiny trains on a CPU in minutes, small in hours, or on a GPU in minutes; paper has the printed sizes."""
    name: str = "run"
    """Name of the run."""
    out: Path = Path("runs")
    """Folder that holds the runs."""
    resume: bool = False
    """Go on from the run's last checkpoint, if it has one, with the settings it was begun with: of the other flags only
    --out, --name, --threads, --accelerator, --devices, --graph, --compile, --workers and --skip-bad count then."""
    apply: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="IDENTITY POSE")] = None
    """Do not train: give the first mesh file the pose of the second, with the weights of run --name."""
    result: Path = Path("posed.obj")
    """Where --apply writes the posed mesh."""

    data: str = "humans"
    """What to train on: humans or animals, which ship with meshkit; smpl:<file> or smal:<file>, a licensed model;
    faust:<folder>, mgn:<folder>, or folder:<folder> of meshes named {identity}_{pose}.obj."""
    skip_bad: bool = False
    """Leave out mesh files that cannot be read, with a warning, instead of ending at the first."""
    minutes: float | None = 8.0
    """Training time; turned into a number of steps once, by the measured speed, and recorded. Paper: 24 to 90 hours."""
    steps: int | None = None
    """Number of steps, instead of --minutes. Paper: 200 epochs of 1600 (X-DualNet)."""
    batch: int = 4
    """Pairs per step, of each process. Paper: 4 (X-DualNet, humans), 6 (animals), 8 (3D-CoreNet)."""
    accumulate: int = 1
    """Batches of this size whose gradients are averaged before each update: larger batches in the same memory."""
    pairs: int = 6400
    """Training pairs per epoch. Paper: 6400 humans, 9000 animals."""
    resample: bool = True
    """Draw new pairs each epoch. Paper: one fixed set."""
    vertices: int | None = None
    """Vertices per mesh, None for the smallest there are: humans have 1000, 2000, 3445 or 6890, animals 1962. Paper:
    6890 and 3889."""
    sampled_identities: int = 0
    """Further training identities, drawn from the Gaussian of the known ones; shipped and licensed rigs alone. Paper:
    SMAL's animals are drawn so."""
    bone_spread: float = 0.0
    """Standard deviation of the logarithm by which each limb of the sampled identities is stretched. Paper: 0."""
    sampled_poses: int = 0
    """Further training poses: the trunk of one of the known ones, each limb of another; rigs alone. Paper: none."""
    pool: int = 1200
    """Training meshes made of a rig, whose signatures are computed beforehand (with --model.descriptors wks)."""
    workers: int = 0
    """Processes that draw pairs; the pairs are the same for any number."""

    model: GeneratorConfig = field(default_factory=GeneratorConfig)
    """Sizes of the generator."""

    init: str | None = None
    """Begin with these weights instead of random ones: a name of meshkit.models.pretrained_names(), or a run's
    folder."""

    lr: float = 1e-3
    """Learning rate. Paper: 1e-4."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Adam's betas. Released code: 0, 0.9."""
    adam_eps: float = 1e-8
    """Adam's eps. Released code: 1e-3."""
    warmup: int = 50
    """Steps over which the learning rate rises from zero. Paper: none."""
    decay_from: float = 0.5
    """Share of the run after which the learning rate falls linearly to zero. Paper: 0.5 (epoch 100 of 200)."""

    eval_pairs: int = 100
    """Unseen pairs at the end. Paper: 400."""
    eval_every: int = 200
    """Steps between evaluations on 24 unseen pairs, for the curve."""
    save_every: int = 100
    """Steps between checkpoints."""
    seed: int = 0
    """Of weights, pairs, vertex orders and handles."""
    threads: int = 0
    """Threads, 0 for torch's choice, and fewer while other programs take cores. At 1 a run repeats bit for bit."""
    precision: Literal["auto", "32-true", "bf16-mixed"] = "auto"
    """auto measures whether bfloat16 is faster here."""
    graph: bool = False
    """Record a training step as a CUDA graph and replay it: several times faster for small networks on a GPU."""
    accelerator: str = "auto"
    """Where to train: auto, cpu, cuda, mps."""
    devices: int = 1
    """Processes, one per GPU or share of the processor. Under torchrun its own flags count instead."""
    compile: bool = False
    """torch.compile what is trained: a minute or more at the start, for faster steps."""


S = TypeVar("S", bound=Settings)


def parse(presets: dict[str, S], description: str | None) -> S:
    """Read the command line against the chosen preset's values; of two presets the last counts."""
    words = sys.argv[1:]
    chosen = "tiny"
    for word, value in pairwise([*words, ""]):
        flag, joined, own = word.partition("=")
        if flag == "--preset":
            chosen = own if joined else value
    default = presets.get(chosen, presets["tiny"])
    return read(type(default), description, default)
