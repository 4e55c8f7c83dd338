"""``pointstream view``: a window on one model.

    controls   camera motions as pure functions
    inputs     what a person did in a frame, and what that does to the view; the table of keys
    commands   what keys, drops and pastes command besides
    keyboard   keys that went down, with their modifiers
    settings   what the panel edits
    recorder   views in time, as a PATH.json
    feed       the access layer in a thread of its own; never waits, never is waited for
    mirror     the frame loop's own copy of what is here
    painter    the renderer on a thread of its own
    culling    when the picture is asked what it hides
    quality    tolerance and cut of the next frame
    screen     the glfw window, the picture on it, Dear ImGui's frame
    scales     tidy numbers: ticks of a legend, length of a scale bar, units
    overlay    what is written on the picture: legend, axes, scale bar, load bar, messages
    panel      settings and statistics beside it
    viewer     one session: the parts put together
    loop       frame after frame, and what they took
    cli        options

glfw, Dear ImGui and OpenGL are imported in `screen`, `keyboard`, `panel` and `overlay` alone: the extra ``window``
brings them.
"""
