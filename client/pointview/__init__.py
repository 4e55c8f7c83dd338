"""Browse a model: camera, refinement, renderers, streaming experiments, and the commands of the viewer."""
