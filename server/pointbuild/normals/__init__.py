"""Normals for scans that have none: k nearest neighbours, smallest eigenvector, consistently oriented, out of core."""

from .field import OrientationField, block_normals
from .scan import EstimatedScan, estimate

__all__ = ["EstimatedScan", "OrientationField", "block_normals", "estimate"]
