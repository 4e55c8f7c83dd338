"""The server as an aiohttp application: routes, header fields of every reply, errors as one line of text."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from aiohttp import HttpVersion11, web

from lpc.errors import NotFound, StoreError

from .catalogue import Catalogue
from .cors import Cors
from .files import FileStore
from .pages import catalogue_page
from .paths import model_names
from .ranges import judge
from .replies import Fields, FileShrunkError, send

if TYPE_CHECKING:
    from .config import ServeConfig

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_UNCACHEABLE: Fields = (("Cache-Control", "no-store"),)

_log = logging.getLogger("pointserve")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Service:
    """What the handlers share."""

    config: ServeConfig
    files: FileStore
    catalogue: Catalogue
    cors: Cors
    wall: Callable[[], float]
    cacheable: Fields


SERVICE = web.AppKey("service", _Service)


def make_app(
    config: ServeConfig, *, clock: Callable[[], float] = time.monotonic, wall: Callable[[], float] = time.time
) -> web.Application:
    """Return the application that serves a folder of models.

    Routes: ``/`` (page), ``/catalogue.json``, ``/healthz``, and every model at its path below the folder.
    """
    app = web.Application(middlewares=[_errors])
    app[SERVICE] = _Service(
        config=config,
        files=FileStore(config.directory, clock=clock, wall=wall, recheck=config.recheck),
        catalogue=Catalogue(config.directory, clock=clock, recheck=config.recheck),
        cors=Cors(config.cors),
        wall=wall,
        cacheable=(("Cache-Control", f"public, max-age={config.max_age}"),),
    )
    app.router.add_get("/", _page)
    app.router.add_get("/catalogue.json", _json)
    app.router.add_get("/healthz", _health)
    app.router.add_route("OPTIONS", "/{path:.*}", _options)
    app.router.add_route("*", "/{path:.*}", _model)
    app.on_response_prepare.append(_finish_fields)
    app.cleanup_ctx.append(_descriptors)
    return app


async def _descriptors(app: web.Application) -> AsyncIterator[None]:
    yield
    app[SERVICE].files.close()


async def _model(request: web.Request) -> web.StreamResponse:
    service = request.app[SERVICE]
    names = model_names(request.rel_url.raw_path)
    if names is None:
        raise NotFound("there is nothing of that name here")
    headers = request.headers

    def field(name: str) -> str | None:
        return ", ".join(headers.getall(name)) if name in headers else None

    for attempt in range(3):
        with service.files.get(names, fresh=attempt > 0).lease() as file:
            verdict = judge(request.method, field, file.facts, now=service.wall())
            extra = service.cacheable if verdict.status in (200, 206, 304) else _UNCACHEABLE
            try:
                return await send(request, file, verdict, extra=extra, config=service.config)
            except FileShrunkError:
                continue  # cut short since it was opened: judge again by what is there now
    raise StoreError(f"{names[-1]} changes faster than it can be read")


async def _page(request: web.Request) -> web.Response:
    entries = await request.app[SERVICE].catalogue.entries()
    page = catalogue_page(entries, _origin(request))
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self'"
    return web.Response(
        text=page, content_type="text/html", headers={"Cache-Control": "no-cache", "Content-Security-Policy": policy}
    )


async def _json(request: web.Request) -> web.Response:
    entries = await request.app[SERVICE].catalogue.entries()
    models = {"models": [entry.to_json() for entry in entries]}
    return web.json_response(models, headers={"Cache-Control": "no-cache"})


async def _health(request: web.Request) -> web.Response:
    entries = await request.app[SERVICE].catalogue.entries()
    return web.Response(text=f"ok, {len(entries)} models\n", headers={"Cache-Control": "no-store"})


async def _options(request: web.Request) -> web.Response:
    fields = request.app[SERVICE].cors.preflight(request.headers.get("Origin"))
    return web.Response(status=204, headers={"Allow": "GET, HEAD, OPTIONS", **fields})


def _origin(request: web.Request) -> str:
    """Scheme and host under which the visitor sees us; a Host field that could be no host is not repeated."""
    host = request.host if re.fullmatch(r"[A-Za-z0-9._-]+(:\d+)?|\[[0-9A-Fa-f:.]+\](:\d+)?", request.host) else "HOST"
    return f"{request.scheme}://{host}"


async def _finish_fields(request: web.Request, response: web.StreamResponse) -> None:
    headers = response.headers
    headers["Server"] = "pointstream"
    headers["X-Content-Type-Options"] = "nosniff"
    request.app[SERVICE].cors.apply(request.headers.get("Origin"), headers)


@web.middleware
async def _errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Turn every error into one line of text; only what we did not foresee ends the connection."""
    if "Host" not in request.headers and request.version == HttpVersion11:  # RFC 9112 3.2
        return _line(400, "an HTTP/1.1 request needs a Host field")
    try:
        return await handler(request)
    except NotFound as error:
        return _line(404, str(error))
    except StoreError as error:
        return _line(503, str(error), {"Retry-After": "5"})
    except web.HTTPException as error:
        allow = {"Allow": error.headers["Allow"]} if "Allow" in error.headers else {}
        return _line(error.status, error.reason.lower(), allow)
    except OSError as error:
        if isinstance(error, ConnectionError):
            raise
        _log.error("%s: %s", request.rel_url.raw_path, error)
        return _line(503, "the served folder cannot be read now", {"Retry-After": "5"})
    except Exception:
        _log.exception("unforeseen error while answering %s", request.rel_url.raw_path)
        response = _line(500, "the server failed; its log says why")
        response.force_close()
        return response


def _line(status: int, text: str, headers: dict[str, str] | None = None) -> web.Response:
    return web.Response(status=status, text=f"{status} {text}\n", headers={**dict(_UNCACHEABLE), **(headers or {})})
