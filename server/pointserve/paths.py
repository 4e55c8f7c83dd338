"""From the path of a URL to names below the served folder: pure, and the only way in.

The raw, still percent-encoded path is split first and each piece decoded once, so an encoded slash, dot or NUL can
never become a separator or a climb: whatever spelling hides one, the piece it stands in is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote, unquote_to_bytes

MODEL_SUFFIX = ".lpc"
CONTENT_TYPES = {MODEL_SUFFIX: "application/octet-stream", ".lpc.png": "image/png"}
"""What is served, by suffix: models, and the picture that may stand beside one (``david.lpc.png``)."""

MAX_NAME_BYTES = 255
MAX_DEPTH = 16


@dataclass(frozen=True, slots=True)
class Place:
    """A file or folder that a path names, whether it is there or not.

    Parameters
    ----------
    names : tuple of str
        Of folders and file below the served folder.
    folder : bool
        The path ends with a slash.
    """

    names: tuple[str, ...]
    folder: bool = False

    @property
    def path(self) -> str:
        """The path in its one canonical spelling."""
        if not self.names:
            return "/"
        return url_path(self.names) + ("/" if self.folder else "")

    def covers(self, other: Place) -> bool:
        """Whether another place is this one, below this folder, or the picture of this model."""
        if self.folder:
            return other.names[: len(self.names)] == self.names and (other.folder or len(other.names) > len(self.names))
        picture = (*self.names[:-1], self.names[-1] + ".png")
        return not other.folder and other.names in (self.names, picture)


def place_of(raw_path: str) -> Place | None:
    """Read a raw URL path; None if it can name nothing below the folder."""
    pieces = raw_path.split("/")
    if pieces[0] or not 2 <= len(pieces) <= MAX_DEPTH + 1:
        return None
    folder = not pieces[-1]
    try:
        names = tuple(unquote_to_bytes(piece).decode() for piece in (pieces[1:-1] if folder else pieces[1:]))
    except UnicodeError:
        return None
    return Place(names, folder) if all(map(is_plain_name, names)) else None


def model_names(raw_path: str) -> tuple[str, ...] | None:
    """Names of folders and file that a raw URL path asks for, or None if it can name nothing that is served."""
    place = place_of(raw_path)
    if place is None or place.folder or content_type(place.names[-1]) is None:
        return None
    return place.names


def is_plain_name(name: str) -> bool:
    """Tell whether a name is one piece of a path, visible, printable and no longer than file systems allow."""
    return (
        bool(name)
        and not name.startswith(".")
        and "/" not in name
        and "\\" not in name
        and name.isprintable()
        and len(name.encode(errors="replace")) <= MAX_NAME_BYTES
    )


def content_type(name: str) -> str | None:
    """Media type of a file by its name; None if files of that name are not served."""
    return next((media for suffix, media in CONTENT_TYPES.items() if name.endswith(suffix)), None)


def url_path(names: tuple[str, ...]) -> str:
    """Inverse of `model_names`; the result needs no quoting in HTML or a shell."""
    return "/" + "/".join(quote(name, safe="") for name in names)
