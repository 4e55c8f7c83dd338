"""Scans in, one .lpc model out."""
