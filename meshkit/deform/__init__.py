"""Deformation of meshes: as-rigid-as-possible, with gradients, and deformation transfer."""

from meshkit.deform.arap import PRESETS, arap_deform
from meshkit.deform.correspondence import key_point_correspondence
from meshkit.deform.deformer import ARAPDeformer
from meshkit.deform.energy import arap_energy
from meshkit.deform.factor import ARAPFactor
from meshkit.deform.moving_least_squares import rigid_moving_least_squares
from meshkit.deform.options import ARAPInfo
from meshkit.deform.poisson import poisson_deform
from meshkit.deform.rest import ARAPRest
from meshkit.deform.rotation import closest_rotation
from meshkit.deform.topology import ARAPTopology
from meshkit.deform.transfer import deformation_transfer
from meshkit.topology import cotangent_laplacian, mass_matrix

__all__ = [
    "PRESETS",
    "ARAPDeformer",
    "ARAPFactor",
    "ARAPInfo",
    "ARAPRest",
    "ARAPTopology",
    "arap_deform",
    "arap_energy",
    "closest_rotation",
    "cotangent_laplacian",
    "deformation_transfer",
    "key_point_correspondence",
    "mass_matrix",
    "poisson_deform",
    "rigid_moving_least_squares",
]
