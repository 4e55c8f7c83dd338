"""Scan files in, batches of samples out: one module a format, all behind `open_scan`."""

from .detect import open_scan
from .scan import ReadOptions, Scan, ScanInfo, finite

__all__ = ["ReadOptions", "Scan", "ScanInfo", "finite", "open_scan"]
