"""The server: models of a folder over HTTP byte ranges. `app.make_app` is the whole of it as an application."""
