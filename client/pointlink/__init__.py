"""The throttled network: one pure link model, a TCP front for real sockets, a virtual clock for the whole HTTP stack.

::

    profiles   what a link is: rates, round-trip time, buffer
    model      one direction of it, pure: which bytes arrive when
    wire       the model on an event loop, real or virtual: bytes in, bytes out, back-pressure
    virtual    an event loop whose clock jumps to the next timer
    origin     a small HTTP/1.1 server of byte ranges; faults: how it can be told to misbehave
    memory     httpx over in-memory connections to an origin
    front      real sockets to any HTTP or TCP server; hosts: the Host header of what passes
    cli        ``pointstream link``
"""
