"""What a server is told at its start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .guard import Guard

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeConfig:
    """Parameters of a server.

    Parameters
    ----------
    directory : Path
        Folder whose models are served, with its sub-folders.
    host : str
        Address to listen on.
    port : int
        Port to listen on; 0 takes a free one.
    cors : tuple of str
        Origins whose pages may read models in a browser (``"https://maps.example"``), or ``("*",)``.
    guard : Guard
        Who may read; everybody, if not given.
    certfile, keyfile : Path or None
        Certificate chain and private key, PEM: speak TLS. The key may stand in `certfile`.
    rate : float or None
        Bits a second that one address gets, over all its connections; None: as many as the line carries.
    recheck : float
        Seconds for which a directory entry is believed before it is looked at again.
    max_age : int
        Seconds for which caches may keep a reply without asking again.
    head_seconds : float
        Seconds in which the head of a request has to come, from its first byte; also those in which a new connection
        has to ask for something, and those of a TLS handshake.
    idle : float
        Seconds after which a connection that asks for nothing is closed.
    patience : float
        Seconds for which a reader may take nothing of a reply.
    slowest : float
        Bytes a second that a reader has to take beyond that.
    connections : int
        Connections at a time; more are told to come back later.
    per_address : int
        Connections at a time from one address. Behind a proxy all visitors have its address.
    grace : float
        Seconds that replies under way get to end when the server stops.
    """

    directory: Path
    host: str = "127.0.0.1"
    port: int = 8080
    cors: tuple[str, ...] = ()
    guard: Guard = field(default_factory=Guard)
    certfile: Path | None = None
    keyfile: Path | None = None
    rate: float | None = None
    recheck: float = 1.0
    max_age: int = 10
    head_seconds: float = 15.0
    idle: float = 75.0
    patience: float = 30.0
    slowest: float = 1024.0
    connections: int = 800
    per_address: int = 256
    grace: float = 60.0
