"""Who may read: bearer tokens, and addresses signed for one model or folder until a moment.

Both are compared in constant time, and neither is ever written anywhere: the access log holds paths without queries.
Whether a path names anything is not looked at before its reader is admitted, so a stranger learns nothing from 401.

A signed address carries ``expires`` (seconds since 1970), for a folder ``scope``, and ``signature``: the HMAC-SHA256
(RFC 2104) of both lines, in hex. The scope is the path in the one spelling that `paths.url_path` gives.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlencode, urlsplit, urlunsplit

from lpc.errors import StoreError

from .paths import MODEL_SUFFIX, Place, place_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

LEAST_SECRET = 16
"""Characters below which a token or a key could be guessed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """What admits a reader; with neither tokens nor key everybody is admitted.

    Parameters
    ----------
    tokens : tuple of bytes
        Any one of them admits to everything.
    key : bytes
        Signs addresses; empty: no address is signed.
    """

    tokens: tuple[bytes, ...] = field(default=(), repr=False)
    key: bytes = field(default=b"", repr=False)

    @property
    def closed(self) -> bool:
        """Whether readers have to show anything."""
        return bool(self.tokens or self.key)

    def admits(self, raw_path: str, authorization: str | None, query: Mapping[str, str], *, now: float) -> bool:
        """Decide about a request; pure.

        Parameters
        ----------
        raw_path : str
            Path of the URL, still percent-encoded.
        authorization : str or None
            Header field: ``Bearer TOKEN``, or ``Basic`` with the token as password, which browsers can ask for.
        query : mapping of str to str
            Of the URL.
        now : float
            Wall clock, seconds since 1970.
        """
        if not self.closed:
            return True
        if authorization is not None and self._knows(_shown_token(authorization)):
            return True
        return bool(self.key) and "signature" in query and self._signed(raw_path, query, now)

    def _knows(self, shown: bytes) -> bool:
        # Hashing first makes the lengths equal; all tokens are compared, so time does not tell which one is near.
        digest = hashlib.sha256(shown).digest()
        return sum(hmac.compare_digest(digest, hashlib.sha256(token).digest()) for token in self.tokens) > 0

    def _signed(self, raw_path: str, query: Mapping[str, str], now: float) -> bool:
        place = place_of(raw_path)
        scope = place_of(query["scope"]) if "scope" in query else place
        expires = query.get("expires", "")
        if place is None or scope is None or not (expires.isascii() and expires.isdigit() and len(expires) < 20):
            return False
        if "scope" not in query and place.names and place.names[-1].endswith(MODEL_SUFFIX + ".png"):
            scope = Place((*place.names[:-1], place.names[-1].removesuffix(".png")))
        genuine = hmac.compare_digest(
            signature(self.key, scope, int(expires)).encode(), query["signature"].encode(errors="replace")
        )
        return genuine and scope.covers(place) and now < int(expires)


def _shown_token(authorization: str) -> bytes:
    scheme, _, value = authorization.partition(" ")
    value = value.strip(" ")
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).partition(b":")[2]
        except (binascii.Error, ValueError):
            return b""
    return value.encode(errors="replace") if scheme.lower() == "bearer" else b""


def signature(key: bytes, scope: Place, expires: int) -> str:
    """Signature of a place until a moment, in hex."""
    return hmac.new(key, f"{scope.path}\n{expires}".encode(), "sha256").hexdigest()


def sign_address(address: str, key: bytes, expires: int) -> str:
    """Return an address with what admits to it; that of a folder ends with a slash and admits to all below it.

    Raises
    ------
    StoreError
        If the address names nothing that a server could serve.
    """
    parts = urlsplit(address)
    place = place_of(parts.path or "/")
    if parts.scheme not in ("http", "https") or not parts.netloc or place is None:
        raise StoreError(f"{address} is no http(s) address of a model or folder")
    if not place.folder and not place.names[-1].endswith(MODEL_SUFFIX):
        raise StoreError(f"{address} is neither a model (.lpc) nor a folder; the address of a folder ends with a slash")
    scope = {"scope": place.path} if place.folder else {}
    query = urlencode({**scope, "expires": expires, "signature": signature(key, place, expires)})
    return urlunsplit((parts.scheme, parts.netloc, place.path, query, ""))


def read_tokens(path: Path) -> tuple[bytes, ...]:
    """Read a file of tokens, one a line; empty lines and lines that begin with # are passed over.

    Raises
    ------
    StoreError
        If it cannot be read, holds none, or one that is too short.
    """
    lines = [line.strip() for line in _read(path).splitlines()]
    tokens = tuple(line for line in lines if line and not line.startswith(b"#"))
    if not tokens or min(map(len, tokens)) < LEAST_SECRET:
        raise StoreError(f"{path}: give one token a line, each of at least {LEAST_SECRET} characters")
    return tokens


def read_key(path: Path) -> bytes:
    """Read the file that holds the signing key.

    Raises
    ------
    StoreError
        If it cannot be read, or the key is too short.
    """
    key = _read(path).strip()
    if len(key) < LEAST_SECRET:
        raise StoreError(f"{path}: a signing key has at least {LEAST_SECRET} bytes; `openssl rand -hex 32` makes one")
    return key


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}") from error
