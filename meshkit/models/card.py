"""Model cards: what a network is made of."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

__all__ = ["ModelCard", "PartCard", "model_card"]


@dataclass(frozen=True)
class PartCard:
    """One part of a model.

    Args:
        name: of the submodule.
        kind: its class.
        parameters: numbers in its parameters.
        inert: how many of them the result does not depend on: they belong to the layout of the paper, but stand before
            a norm that takes them out again.
        buffers: numbers in its buffers.
        bytes: size of parameters and buffers in memory.
    """

    name: str
    kind: str
    parameters: int
    inert: int
    buffers: int
    bytes: int


@dataclass(frozen=True)
class ModelCard:
    """The parts of a model; ``str(card)`` is a Markdown table.

    Args:
        whole: the model itself.
        parts: its submodules.
    """

    whole: PartCard
    parts: tuple[PartCard, ...]

    def __str__(self) -> str:
        rows = [
            f"| {p.name} | {p.kind} | {p.parameters:,} | {p.inert:,} | {p.buffers:,} | {p.bytes / 1e6:.1f} |"
            for p in (*self.parts, self.whole)
        ]
        head = "| part | module | parameters | of these inert | buffers | MB |\n|---|---|---:|---:|---:|---:|"
        return "\n".join([head, *rows])


def model_card(model: nn.Module) -> ModelCard:
    """Count what a model holds, part by part.

    Args:
        model: any module; its direct submodules with parameters or buffers are the parts.

    Returns:
        The :class:`ModelCard`. Submodules with a method ``inert_parameters`` say themselves which of their parameters
        are inert.

    Example:
        >>> print(model_card(nn.Sequential(nn.Linear(2, 3), nn.ReLU(), nn.BatchNorm1d(3))))
        | part | module | parameters | of these inert | buffers | MB |
        |---|---|---:|---:|---:|---:|
        | 0 | Linear | 9 | 0 | 0 | 0.0 |
        | 2 | BatchNorm1d | 6 | 0 | 7 | 0.0 |
        | total | Sequential | 15 | 0 | 7 | 0.0 |
    """
    inert = {
        f"{prefix}.{name}".lstrip(".")
        for prefix, module in model.named_modules()
        for name in getattr(module, "inert_parameters", list)()
    }
    parts = [_part(name, child, inert, name) for name, child in model.named_children()]
    return ModelCard(_part("total", model, inert, ""), tuple(p for p in parts if p.bytes))


def _part(name: str, module: nn.Module, inert: set[str], prefix: str) -> PartCard:
    parameters, buffers = dict(module.named_parameters(prefix)), list(module.buffers())
    return PartCard(
        name=name,
        kind=type(module).__name__,
        parameters=sum(p.numel() for p in parameters.values()),
        inert=sum(p.numel() for n, p in parameters.items() if n in inert),
        buffers=sum(b.numel() for b in buffers),
        bytes=sum(t.numel() * t.element_size() for t in (*parameters.values(), *buffers)),
    )
