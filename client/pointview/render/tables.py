"""What the kernels are told of a frame, and what they tell each other of a sample: types of rows, no code."""

from __future__ import annotations

import numpy as np

STEPS = 16
"""Codes of `thin` to a doubling of the spacing."""

CLOUD = np.dtype(
    [
        ("node", np.int32),
        ("first", np.int64),  # row of its first sample
        ("count", np.int64),
        ("place", np.int64),  # of its first sample
        ("x", np.float32),  # position of the cloud's (0, 0, 0) relative to the eye
        ("y", np.float32),
        ("z", np.float32),
        ("scale", np.float32),  # model units of a step
        ("spacing", np.float32),  # to close, model units; the next say where it differs inside the cloud
        ("starved", np.bool_),
        ("row", np.int32),  # of its node in PLACE
        ("level", np.int32),  # of its node; -1 where all samples close the spacing above
        ("corner_x", np.float32),  # position of the cloud's (0, 0, 0) relative to the corner of its node's cell
        ("corner_y", np.float32),
        ("corner_z", np.float32),
        ("thin", np.bool_),  # whether samples have a spacing of their own; see `thin`
        ("alone", np.float32),  # model units of a step, times what `places` says of the node's own samples
    ]
)
"""A cloud of the frame."""

PLACE = np.dtype(
    [
        ("lower", np.int32),  # rows of the drawn nodes in the halves of the cell; -1 where the half ends here
        ("upper", np.int32),
        ("lower_spacing", np.float32),  # to close there; negative where starved
        ("upper_spacing", np.float32),
        ("spread", np.float32),  # see `places`
    ]
)
"""A drawn node (see `places`)."""

HALVING = np.dtype([("axis", np.int32), ("half", np.float32)])
"""How the cells of a level are halved (see `places`)."""

VIEW = np.dtype(
    [
        ("width", np.float32),
        ("height", np.float32),
        ("focal", np.float32),
        ("near", np.float32),
        ("largest", np.float32),  # side of a splat, pixels; see `splats` for this and the next six
        ("round_from", np.float32),
        ("round", np.float32),
        ("bulge", np.float32),
        ("steepest", np.float32),
        ("closing", np.float32),  # side of a splat over the spacing to close, times the focal length
        ("reach", np.float32),
        ("cull", np.bool_),  # drop samples whose normal points away
        ("oriented", np.bool_),  # samples with normals are discs in their tangent plane
    ]
)
"""What all splats of a frame share."""

LIGHT = np.dtype(
    [
        ("ambient", np.float32),  # see `shading`
        ("diffuse", np.float32),
        ("specular", np.float32),
        ("squarings", np.int32),  # so often the highlight is squared: the logarithm of the shininess
        ("unlit", np.float32),
        ("lamp_x", np.float32),  # unit vector, axes of model space
        ("lamp_y", np.float32),
        ("lamp_z", np.float32),
        ("lit", np.bool_),
        ("two_sided", np.bool_),
    ]
)
"""How samples are lit."""

SAMPLE = np.dtype(
    [
        ("right", np.float32),  # camera space
        ("up", np.float32),
        ("depth", np.float32),
        ("nx", np.float32),  # of its plane, camera space
        ("ny", np.float32),
        ("nz", np.float32),
        ("side", np.float32),  # of its splat, pixels
        ("red", np.float32),  # lit, and linear in light
        ("green", np.float32),
        ("blue", np.float32),
    ]
)
"""A sample as the eye sees it."""
