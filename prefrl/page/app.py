"""The application: what each address answers. What it does lies in `service`; what it refuses at once in `security`."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp

from prefrl.page import api
from prefrl.page import static_files as pages
from prefrl.page.access import Person
from prefrl.page.admin import admin_routes
from prefrl.page.clips.queue import ClipBusy, ClipFailed, ClipUnknown
from prefrl.page.people import cookie_name, errors, person, service_of, viewer
from prefrl.page.security import Guard, Refused, Rules
from prefrl.page.service import Service
from prefrl.page.trainer import trainer_routes
from prefrl.page.writer import Unavailable
from prefrl.storage.log import StoreError, StoreFull
from prefrl.types import Json

CLIP_SECONDS = 20.0
"""How long a clip that is not drawn yet is waited for, before the page is told to ask again."""
MONTH = 30 * 24 * 3600
MEDIA = {"mp4": "video/mp4", "webm": "video/webm", "webp": "image/webp"}
Someone = Annotated[Person, Depends(person)]
Served = Annotated[Service, Depends(service_of)]


def create_app(service: Service, rules: Rules | None = None) -> ASGIApp:
    """The whole application on an open service, guarded."""
    return Guard(routes(service), rules or Rules())


def routes(service: Service) -> FastAPI:
    """The application without its guard; its `openapi()` describes it. Nothing of that is served."""
    app = FastAPI(
        title="prefrl", openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False, responses=errors(422)
    )
    app.state.service = service
    _explain_errors(app)
    _add_pages(app, service.terms.page.title)
    _add_session(app)
    _add_work(app)
    _add_record(app)
    app.include_router(admin_routes())
    app.include_router(trainer_routes())
    return app


def _add_pages(app: FastAPI, title: str) -> None:
    html, table = pages.shell(title), pages.static_files()

    async def shell() -> HTMLResponse:
        return HTMLResponse(html, headers={"cache-control": "no-cache"})

    for path in ("/", "/label", "/history", "/guide", "/admin"):
        app.get(path, response_class=HTMLResponse, summary="The page")(shell)

    @app.get("/static/{name}", responses=errors(404))
    async def static(name: str, request: Request) -> Response:
        """A file of the page."""
        file = table.get(name)
        if file is None:
            raise Refused(404, "there is no such file")
        headers = {"cache-control": "no-cache", "etag": file.etag}
        if request.headers.get("if-none-match") == file.etag:
            return Response(status_code=304, headers=headers)
        return Response(file.body, media_type=file.media_type, headers=headers)

    @app.get("/healthz", responses={503: {"description": "Nothing can be stored"}})
    async def health(served: Served) -> JSONResponse:
        """Whether answers can be stored."""
        writer = served.writer.alive and not served.writer.trouble
        told = {"ok": writer, "writer": writer, "read_only": served.read_only, "waiting": served.writer.waiting}
        return JSONResponse(told, 200 if writer else 503)

    @app.get("/media/{name}", responses=errors(401, 404, 416, 422, 503), response_class=FileResponse)
    async def media(name: str, who: Annotated[Person, Depends(viewer)], served: Served) -> FileResponse:
        """A clip, or a part of it."""
        if served.clips is None:
            raise Refused(404, "there is no such clip")
        path = await served.clips.get(name, CLIP_SECONDS)
        headers = {"cache-control": "private, max-age=31536000, immutable"}  # what looks otherwise has another name
        return FileResponse(path, media_type=MEDIA[name.rpartition(".")[2]], headers=headers)


def _add_session(app: FastAPI) -> None:
    @app.post("/api/session", responses=errors(401, 403, 429, 503, 507))
    async def login(sent: api.Login, request: Request, response: Response, served: Served) -> api.Me:
        """Exchange an invite for a session."""
        address = request.client.host if request.client else ""
        served.logins.take(address)
        found = served.access.who(sent.token, "invite")
        if found is None:
            raise Refused(401, "this link does not work, or no longer: ask for a new one")
        served.logins.give_back(address)  # guesses are counted: many people may share an address
        served.requests.take(found.name)
        if found.role == "trainer":
            raise Refused(403, "this link is for a program that reads labels, not for a browser")
        token, events = served.access.session(found.name)
        await served.record(events)
        secure = request.url.scheme == "https"
        name = cookie_name(served)
        # No script can read it, and no other site can have it sent along.
        response.set_cookie(name, token, max_age=MONTH, httponly=True, samesite="strict", secure=secure)
        return await _me(served, found)

    @app.delete("/api/session", status_code=204, responses=errors(401, 403, 503, 507))
    async def logout(request: Request, who: Someone, served: Served) -> Response:
        """End the session."""
        await served.record(served.access.leave(request.cookies[cookie_name(served)]))
        response = Response(status_code=204)
        response.delete_cookie(cookie_name(served), httponly=True, samesite="strict")
        return response

    @app.get("/api/me", responses=errors(401, 403, 429))
    async def me(who: Someone, served: Served) -> api.Me:
        """Who I am, and how the page behaves."""
        return await _me(served, who)

    @app.get(
        "/api/state", response_model=api.State, responses=errors(401, 403, 429) | {304: {"description": "As it was"}}
    )
    async def state(request: Request, who: Someone, served: Served, since: int = 0) -> Response:
        """How things stand; asked every few seconds."""
        found = api.State(
            seq=served.seq,
            progress=await served.progress(who.name),
            guideline=served.guideline.version,
            paused=who.state == "paused",
            read_only=served.read_only,
            finished=served.finished,
            consent=served.consent.owed(who.name),
        )
        body = found.model_dump_json().encode()
        headers = {"etag": f'"{hashlib.sha256(body).hexdigest()[:16]}"'}
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return Response(body, media_type="application/json", headers=headers)


def _add_work(app: FastAPI) -> None:
    @app.post("/api/assignments", responses=errors(401, 403, 413, 415, 429, 503))
    async def assignments(sent: api.Want, who: Someone, served: Served) -> api.Assignments:
        """Questions to answer: those I hold already first."""
        if who.state == "paused":
            return api.Assignments(assignments=[], reason="paused")
        if served.finished:
            return api.Assignments(assignments=[], reason="done")
        if served.consent.owed(who.name):
            return api.Assignments(assignments=[], reason="consent")
        try:
            found = await served.assign(who.name, sent.want)
        except StoreFull:
            return api.Assignments(assignments=[], reason="read-only")
        nothing = "done" if served.terms.fixed else "waiting"
        return api.Assignments(assignments=found, reason=None if found else nothing)

    @app.post("/api/heartbeat", status_code=204, responses=errors(401, 403, 413, 415, 429))
    async def heartbeat(sent: api.Heartbeat, who: Someone, served: Served) -> None:
        """I am still at work on these."""
        served.desk.extend(who.name, sent.assignments)

    @app.post("/api/answers", responses=errors(401, 403, 404, 409, 413, 415, 429, 503, 507))
    async def answers(sent: api.Answer, who: Someone, served: Served) -> api.Receipt:
        """An answer. It is on disk when this returns."""
        return await served.answer(who.name, sent)

    @app.post("/api/drafts", responses=errors(401, 403, 404, 409, 413, 415, 429))
    async def drafts(sent: api.Draft, who: Someone, served: Served) -> api.Measured:
        """What something that I may send comes to: how long it is, and whether it would be taken. Nothing is stored."""
        return await served.measure(who.name, sent)

    @app.post("/api/undo", responses=errors(401, 403, 404, 409, 413, 415, 429, 503, 507))
    async def undo(sent: api.Undo, who: Someone, served: Served) -> api.Undone:
        """Take one of my last answers back."""
        return await served.undo(who.name, sent)


def _add_record(app: FastAPI) -> None:
    @app.get("/api/history", responses=errors(401, 403, 429))
    async def history(who: Someone, served: Served) -> api.History:
        """My last answers, newest first."""
        return api.History(entries=await served.history(who.name))

    @app.post("/api/flags", responses=errors(401, 403, 404, 409, 413, 415, 429, 503, 507))
    async def flags(sent: api.Flag, who: Someone, served: Served) -> api.Receipt:
        """Report a problem."""
        return await served.flag(who.name, sent)

    @app.get("/api/guideline", responses=errors(401, 403, 429))
    async def guideline(who: Someone, served: Served) -> api.Guideline:
        """How to judge."""
        return served.guideline

    @app.get("/api/consent", responses=errors(401, 403, 429))
    async def consent(who: Someone, served: Served) -> api.Consent:
        """What I am to agree to before my first question."""
        return api.Consent(version=served.consent.version, text=served.consent.text)

    @app.post("/api/consent", status_code=204, responses=errors(401, 403, 409, 413, 415, 429, 503, 507))
    async def agree(sent: api.Agreement, who: Someone, served: Served) -> None:
        """I agree."""
        await served.agree(who.name, sent.version)


async def _me(served: Service, who: Person) -> api.Me:
    progress = await served.progress(who.name)
    return api.Me(
        store=served.store_id,
        name=who.name,
        role=who.role,
        page=served.terms.page,
        progress=progress,
        guideline=served.guideline.version,
        consent=served.consent.owed(who.name),
    )


def _explain_errors(app: FastAPI) -> None:
    """One sentence for whatever goes wrong, and never what was sent."""

    def handler(status: int, retry: int | None = None) -> Any:
        async def explain(_: Request, error: Exception) -> JSONResponse:
            return _failure(status, str(error), retry)

        return explain

    async def refused(_: Request, error: Any) -> JSONResponse:
        return _failure(error.status, error.error, error.retry_after)

    async def invalid(_: Request, error: Any) -> JSONResponse:
        return _failure(422, "; ".join(dict.fromkeys(map(_mistake, error.errors()[:3]))))

    async def http(_: Request, error: Any) -> JSONResponse:
        text = {404: "there is nothing at this address", 405: "this address does not take that method"}
        return JSONResponse({"error": text.get(error.status_code, str(error.detail))}, error.status_code, error.headers)

    async def broken(_: Request, error: Exception) -> JSONResponse:  # the guard hears of it as well, and logs it
        return _failure(500, "something went wrong on the server; what was acknowledged is safe")

    app.add_exception_handler(Exception, broken)
    app.add_exception_handler(Refused, refused)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
    for kind, status, retry in (
        (StoreFull, 507, 30),
        (StoreError, 409, None),
        (Unavailable, 503, 2),
        (ClipUnknown, 404, None),
        (ClipFailed, 422, None),
        (ClipBusy, 503, 2),
    ):
        app.add_exception_handler(kind, handler(status, retry))


def _failure(status: int, error: str, retry: float | None = None) -> JSONResponse:
    headers = {} if retry is None else {"retry-after": str(max(1, round(retry)))}
    return JSONResponse({"error": error}, status, headers)


def _mistake(one: Json) -> str:
    """What is wrong with a body, without repeating it."""
    where = ".".join(str(part)[:40] for part in one["loc"] if part != "body")
    return f"{where}: {one['msg']}" if where else str(one["msg"])
