"""Which pages of other origins may read models in a browser: none, unless told (Fetch standard, CORS)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import MutableMapping

_EXPOSED = "Accept-Ranges, Content-Length, Content-Range, ETag, Last-Modified"
_ALLOWED = "Authorization, If-Match, If-None-Match, If-Range, Range"


class Cors:
    """The fields that let the allowed origins in.

    Parameters
    ----------
    origins : tuple of str
        Origins as browsers send them, or ``("*",)`` for all; empty: no fields at all.
    """

    def __init__(self, origins: tuple[str, ...]) -> None:
        self._origins = frozenset(origins)

    def apply(self, origin: str | None, headers: MutableMapping[str, str]) -> None:
        """Add the fields of a plain reply."""
        if not self._origins:
            return
        if "*" in self._origins:
            headers["Access-Control-Allow-Origin"] = "*"
        else:
            headers["Vary"] = "Origin"
            if origin not in self._origins:
                return
            headers["Access-Control-Allow-Origin"] = str(origin)
        headers["Access-Control-Expose-Headers"] = _EXPOSED

    def preflight(self, origin: str | None) -> dict[str, str]:
        """Return the fields that only the reply to a preflight has, beside those of `apply`."""
        if not self._origins & {"*", origin}:
            return {}
        return {
            "Access-Control-Allow-Methods": "GET, HEAD",
            "Access-Control-Allow-Headers": _ALLOWED,
            "Access-Control-Max-Age": "86400",
        }
