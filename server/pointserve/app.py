"""The server as an aiohttp application: routes, header fields of every reply, errors as one line of text."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from aiohttp import HttpVersion11, web

from lpc.errors import NotFound, StoreError

from .accesslog import BEGAN, LOGGER, SENT_BYTES, Ledger
from .board import ADMISSION, Board, Seat
from .catalogue import Catalogue, Entry
from .cors import Cors
from .files import FileStore
from .metrics import MEDIA_TYPE, exposition
from .pages import catalogue_page
from .paths import model_names, place_of
from .ranges import judge
from .rate import RateCap
from .replies import Fields, FileShrunkError, Pace, send

if TYPE_CHECKING:
    from .config import ServeConfig

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_UNCACHEABLE: Fields = (("Cache-Control", "no-store"),)
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="models", Basic realm="models"'}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Service:
    """What the handlers share."""

    config: ServeConfig
    files: FileStore
    catalogue: Catalogue
    cors: Cors
    pace: Pace
    seat: Seat
    ledger: Ledger
    wall: Callable[[], float]
    cacheable: Fields


SERVICE = web.AppKey("service", _Service)


def make_app(
    config: ServeConfig,
    *,
    clock: Callable[[], float] = time.monotonic,
    wall: Callable[[], float] = time.time,
    seat: Seat | None = None,
) -> web.Application:
    """Return the application that serves a folder of models.

    Routes: ``/`` and every folder below it (page), ``catalogue.json`` in each, ``/healthz``, ``/metrics``, and every
    model at its path below the folder.
    """
    seat = seat or Board().seat(0)
    cap = None if config.rate is None else RateCap(config.rate / 8, clock=clock, share=seat.share)
    keepers = "private" if config.guard.closed else "public"
    app = web.Application(middlewares=[_errors])
    app[SERVICE] = _Service(
        config=config,
        files=FileStore(config.directory, clock=clock, wall=wall, recheck=config.recheck),
        catalogue=Catalogue(config.directory, clock=clock, recheck=config.recheck),
        cors=Cors(config.cors),
        pace=Pace(patience=config.patience, slowest=config.slowest, cap=cap),
        seat=seat,
        ledger=Ledger(seat, clock),
        wall=wall,
        cacheable=(("Cache-Control", f"{keepers}, max-age={config.max_age}"),),
    )
    models = r"/{path:.*\.lpc(?:\.png)?}"  # first, and with one pattern: most requests are for these
    app.router.add_route("OPTIONS", models, _options)
    app.router.add_route("*", models, _model)
    app.router.add_route("OPTIONS", "/{path:.*}", _options)
    app.router.add_get("/healthz", _health)
    app.router.add_get("/metrics", _metrics)
    app.router.add_get(r"/{path:(?:.*/)?}", _page)
    app.router.add_get(r"/{path:(?:.*/)?}catalogue.json", _json)
    app.router.add_route("*", "/{path:.*}", _model)
    app.on_response_prepare.append(_finish_fields)
    app.cleanup_ctx.append(_descriptors)
    return app


def ledger_of(app: web.Application) -> Ledger:
    """Return what counts the replies of an application."""
    return app[SERVICE].ledger


async def _descriptors(app: web.Application) -> AsyncIterator[None]:
    yield
    app[SERVICE].files.close()


async def _model(request: web.Request) -> web.StreamResponse:
    service = request.app[SERVICE]
    names = model_names(request.rel_url.raw_path)
    if names is None:
        raise NotFound(request.rel_url.raw_path)
    headers = request.headers

    def field(name: str) -> str | None:
        return ", ".join(headers.getall(name)) if name in headers else None

    for attempt in range(3):
        with service.files.get(names, fresh=attempt > 0).lease() as file:
            verdict = judge(request.method, field, file.facts, now=service.wall())
            extra = service.cacheable if verdict.status in (200, 206, 304) else _UNCACHEABLE
            try:
                return await send(request, file, verdict, extra=extra, pace=service.pace)
            except FileShrunkError:
                continue  # cut short since it was opened: judge again by what is there now
    raise StoreError(f"{names[-1]} changes faster than it can be read")


async def _page(request: web.Request) -> web.Response:
    query = request.rel_url.raw_query_string if "signature" in request.rel_url.query else ""
    page = catalogue_page(await _listed(request), _origin(request), query=query)
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self'"
    headers = {"Cache-Control": "no-cache", "Content-Security-Policy": policy, "Referrer-Policy": "no-referrer"}
    return web.Response(text=page, content_type="text/html", headers=headers)


async def _json(request: web.Request) -> web.Response:
    models = {"models": [entry.to_json() for entry in await _listed(request)]}
    return web.json_response(models, headers={"Cache-Control": "no-cache"})


async def _listed(request: web.Request) -> tuple[Entry, ...]:
    """Entries of the folder that a request names; an empty folder is none, except the served one."""
    place = place_of(request.rel_url.raw_path.removesuffix("catalogue.json"))
    entries = () if place is None else await request.app[SERVICE].catalogue.entries()
    below = () if place is None else place.names
    found = tuple(entry for entry in entries if entry.names[: len(below)] == below and entry.names != below)
    if not found and (place is None or below):
        raise NotFound(request.rel_url.raw_path)
    return found


async def _health(request: web.Request) -> web.Response:
    service = request.app[SERVICE]
    models = await _count_models(service)
    text = "ok\n" if service.config.guard.closed else f"ok, {models} models\n"
    return web.Response(text=text, headers=dict(_UNCACHEABLE))


async def _metrics(request: web.Request) -> web.Response:
    service = request.app[SERVICE]
    body = exposition(service.seat.board, await _count_models(service))
    return web.Response(body=body, headers={"Content-Type": MEDIA_TYPE, **dict(_UNCACHEABLE)})


async def _count_models(service: _Service) -> int:
    return sum(entry.header is not None for entry in await service.catalogue.entries())


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
    if response.status != 206:  # a part is no page; on a slow line each byte of its head delays a cloud
        headers["X-Content-Type-Options"] = "nosniff"
    request.app[SERVICE].cors.apply(request.headers.get("Origin"), headers)


def _admitted(request: web.Request, service: _Service) -> bool:
    """Whether a request may go on. Health is everybody's, and browsers send preflights without credentials."""
    guard, path = service.config.guard, request.rel_url.raw_path
    if not guard.closed or path == "/healthz" or request.method == "OPTIONS":
        return True
    shown = request.headers.get("Authorization")
    return guard.admits(path, shown, request.rel_url.query, now=service.wall())


@web.middleware
async def _errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Turn every error into one line of text; only what we did not foresee ends the connection."""
    if "Host" not in request.headers and request.version == HttpVersion11:  # RFC 9112 3.2
        return _line(400, "an HTTP/1.1 request needs a Host field")
    service = request.app[SERVICE]
    request[BEGAN] = service.ledger.clock()
    if not _admitted(request, service):
        service.seat.row[ADMISSION] += 1
        return _line(401, "show a token, or a signed address that has not expired", _CHALLENGE)
    try:
        return await handler(request)
    except (ConnectionError, asyncio.CancelledError):
        # The reader has gone, or the server stops: aiohttp writes no line for a reply that did not end.
        service.ledger.note(request, 499, request.get(SENT_BYTES, 0), cut=True)
        raise
    except NotFound:
        return _line(404, "there is nothing of that name here")  # the same words for what is hidden and what is absent
    except StoreError as error:
        return _line(503, str(error), {"Retry-After": "5"})
    except web.HTTPException as error:
        allow = {"Allow": error.headers["Allow"]} if "Allow" in error.headers else {}
        return _line(error.status, error.reason.lower(), allow)
    except OSError as error:
        LOGGER.error("%s: %s", request.rel_url.raw_path, error)
        return _line(503, "the served folder cannot be read now", {"Retry-After": "5"})
    except Exception:
        LOGGER.exception("unforeseen error while answering %s", request.rel_url.raw_path)
        response = _line(500, "the server failed; its log says why")
        response.force_close()
        return response


def _line(status: int, text: str, headers: dict[str, str] | None = None) -> web.Response:
    return web.Response(status=status, text=f"{status} {text}\n", headers={**dict(_UNCACHEABLE), **(headers or {})})
