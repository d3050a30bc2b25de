"""Intrinsic descriptors of a mesh or point cloud from the spectrum of its Laplacian."""

from meshkit.descriptors.eigenpairs import laplacian_eigenpairs
from meshkit.descriptors.intrinsic import intrinsic_descriptors
from meshkit.descriptors.signatures import heat_kernel_signature, wave_kernel_signature

__all__ = ["heat_kernel_signature", "intrinsic_descriptors", "laplacian_eigenpairs", "wave_kernel_signature"]
