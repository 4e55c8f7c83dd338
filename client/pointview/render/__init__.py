"""Drawing a cut: one interface (`backend`), a CPU and an OpenGL implementation of it.

The CPU backend is the default wherever OpenGL would run in software: it is several times quicker there and gives the
same picture. moderngl is imported only when OpenGL is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from lpc.errors import Unavailable

from .backend import Backend, Frame, Splat, Style, Take
from .cpu import CpuBackend

if TYPE_CHECKING:
    from lpc.header import Header

__all__ = ["Backend", "Frame", "Kind", "Splat", "Style", "Take", "open_backend"]

Kind = Literal["auto", "gl", "cpu"]

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader", "software")
"""Words in the names of OpenGL renderers that run on the CPU."""


def open_backend(kind: Kind, header: Header, *, threads: int = 1) -> Backend:
    """Open a renderer of one model.

    Parameters
    ----------
    kind : {"auto", "gl", "cpu"}
        ``auto`` takes OpenGL only where hardware drives it.
    threads : int
        Threads of the CPU backend.

    Raises
    ------
    Unavailable
        If OpenGL was asked for and there is none.
    """
    if kind != "cpu":
        try:
            from .gl import GlBackend  # moderngl is needed here alone

            backend = GlBackend(header)
        except Unavailable:
            if kind == "gl":
                raise
        else:
            if kind == "gl" or not any(word in backend.renderer.lower() for word in SOFTWARE):
                return backend
            backend.close()
    return CpuBackend(header, threads=threads)
