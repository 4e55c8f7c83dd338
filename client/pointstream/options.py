"""Parameters of the access layer."""

from __future__ import annotations

from dataclasses import dataclass, field

from .recovery import RecoveryOptions
from .scheduler import SchedulerOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerOptions:
    """Parameters of the access layer.

    Parameters
    ----------
    capacity : int
        Bytes of decoded clouds in memory; only the current cut may pass it.
    decode_threads : int
    decode_backlog : int
        Bytes that have arrived and wait to be decoded, at most, before more are asked for.
    most_orphans : int
        Bytes of clouds that have arrived before their ancestors, at most, before those whose ancestors are not on their
        way are let go.
    tries : int
        Fetches of a cloud or page that fails its checks, before it stays missing.
    scheduler : SchedulerOptions
    recovery : RecoveryOptions
    """

    capacity: int = 512 << 20
    decode_threads: int = 2
    decode_backlog: int = 1 << 20
    most_orphans: int = 4 << 20
    tries: int = 3
    scheduler: SchedulerOptions = field(default_factory=SchedulerOptions)
    recovery: RecoveryOptions = field(default_factory=RecoveryOptions)
