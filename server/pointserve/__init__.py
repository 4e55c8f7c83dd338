"""The HTTP server of models: byte ranges by the book, a catalogue, limits and figures."""
