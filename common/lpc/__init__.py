"""The format .lpc, pure: samples, clouds, codec, header, index tree and byte layout. No I/O, no clock, no sibling."""
