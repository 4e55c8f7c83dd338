"""Scans in, one .lpc model out."""

from .build import BuildReport, build_model
from .options import BuildOptions

__all__ = ["BuildOptions", "BuildReport", "build_model"]
