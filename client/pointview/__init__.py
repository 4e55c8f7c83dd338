"""Looking at models: camera, refinement, renderers, streaming reports."""
