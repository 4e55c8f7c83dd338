"""Streaming experiments: run a view or a camera path over a link, and report error against run time."""
