"""The one error tree of the project.

::

    LpcError                       everything a user can be told about in one line
    ├── FormatError (ValueError)   bytes that are not what docs/format.md says
    │   ├── NotAModel              the first bytes are no .lpc header
    │   ├── UnsupportedVersion     an older or newer format than this program reads
    │   └── Corrupt                lengths, counts, checksums or shapes that cannot be true
    │       └── Truncated          the bytes given end too early; `needed` says how many it takes
    ├── StoreError (OSError)       a model that cannot be reached or read
    │   ├── NotFound               no such file or address
    │   ├── RangesUnsupported      the host ignores Range
    │   ├── ModelChanged           another build stands at the same address now
    │   └── Unavailable            gave up after retries
    ├── ScanError (ValueError)     an input scan that cannot be read or holds nothing
    └── BuildError                 a build that cannot go on (disk, memory ceiling, options)

Foreign exceptions are translated into these once, where they enter. The text is one line that says what is
wrong and what to do about it; the command line prints it on stderr and exits with status 1.
"""

from __future__ import annotations


class LpcError(Exception):
    """Base of every error that pointstream raises on purpose."""


class FormatError(LpcError, ValueError):
    """Bytes that do not follow docs/format.md."""


class NotAModel(FormatError):
    """The first bytes are not a .lpc header."""


class UnsupportedVersion(FormatError):
    """The file is of a format version that this program cannot read."""


class Corrupt(FormatError):
    """A length, count, checksum or shape that cannot be true; the text names the place."""


class Truncated(Corrupt):
    """The bytes given end too early.

    Attributes
    ----------
    needed : int
        Bytes from the start of what was given that are needed to go on.
    """

    def __init__(self, message: str, needed: int) -> None:
        super().__init__(message)
        self.needed = needed


class StoreError(LpcError, OSError):
    """A model that cannot be reached or read."""


class NotFound(StoreError):
    """There is no file or address of that name."""


class RangesUnsupported(StoreError):
    """The host answers range requests with the whole file."""


class ModelChanged(StoreError):
    """Another build of the model stands at the same address now."""


class Unavailable(StoreError):
    """The host did not deliver after all retries."""


class ScanError(LpcError, ValueError):
    """An input scan that cannot be read or holds no usable sample."""


class BuildError(LpcError):
    """A build that cannot go on."""
