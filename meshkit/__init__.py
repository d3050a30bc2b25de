"""meshkit: exact, differentiable geometry-learning components for PyTorch.

Every component is imported from its own subpackage (``from meshkit.norm import ElaIN``); this module imports nothing,
so that one component never drags in the rest.
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
