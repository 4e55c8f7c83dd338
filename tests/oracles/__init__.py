"""Slow, obvious counterparts of the real thing, for tests of every room."""
