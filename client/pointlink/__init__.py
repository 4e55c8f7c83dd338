"""The throttled network: one pure link model, a TCP front for real sockets, a virtual clock for the whole HTTP stack.

::

    profiles   what a link is: rates, round-trip time, buffer
    model      one direction of it, pure: which bytes arrive when
    wire       the model on an event loop, real or virtual: bytes in, bytes out, back-pressure
    virtual    an event loop whose clock jumps to the next timer
    resources  what an origin serves, and which reply a range request gets
    origin     a small HTTP/1.1 server of byte ranges, over streams in memory or real sockets
    faults     how an origin can be told to misbehave
    stream     one end of an in-memory connection
    memory     httpx over in-memory connections to an origin
    front      real sockets to any HTTP or TCP server
    relay      one socket of a connection through the front
    hosts      the Host header of the requests that pass it
    cli        ``pointstream link``
"""
