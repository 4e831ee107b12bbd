"""What admins see and change."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Request
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool

from prefrl.exchange.exports.given import Exported
from prefrl.kinds import named
from prefrl.page import api
from prefrl.page.access import Person
from prefrl.page.api import Health, Link, Overview
from prefrl.page.people import admin, errors, service_of
from prefrl.page.security import Refused
from prefrl.page.service import Service
from prefrl.store import Store
from prefrl.types import Json

Admin = Annotated[Person, Depends(admin)]
Served = Annotated[Service, Depends(service_of)]


def admin_routes() -> APIRouter:
    router = APIRouter()
    _add_overview(router)
    _add_people(router)
    _add_project(router)
    return router


def _add_overview(router: APIRouter) -> None:
    @router.get("/api/admin/overview", responses=errors(401))
    async def overview(who: Admin, served: Served) -> Overview:
        """Everything that the dashboard shows."""
        return await run_in_threadpool(_overview, served)

    @router.get("/api/admin/export/{name}", responses=errors(401, 404, 409), response_class=FileResponse)
    async def export(name: str, who: Admin, served: Served) -> FileResponse:
        """Answers as a file; the header Prefrl-About says, as JSON, what it could not hold."""
        known = _exports(served)
        if name not in known:
            raise Refused(404, f"there is no such export: choose from {', '.join(known)}")
        path, done = await run_in_threadpool(_export, served, name)
        about = {"file": path.name, "written": done.written, "left_out": done.dropped, "notes": done.notes}
        clear = BackgroundTask(shutil.rmtree, path.parent, ignore_errors=True)
        return FileResponse(path, filename=path.name, background=clear, headers={"prefrl-about": json.dumps(about)})


def _add_people(router: APIRouter) -> None:
    @router.post("/api/admin/annotators", responses=errors(401, 409, 413, 415, 507))
    async def add(sent: api.NewAnnotator, request: Request, who: Admin, served: Served) -> Link:
        """Invite somebody new."""
        if served.access.person(sent.name) is not None:
            raise Refused(409, f"there is somebody called {sent.name} already: make a new link for them instead")
        return await _invite(served, request, sent.name, sent.role)

    @router.post("/api/admin/annotators/{name}/{verb}", responses=errors(401, 404, 409, 507))
    async def change(
        name: str, verb: Literal["pause", "resume", "revoke", "invite"], request: Request, who: Admin, served: Served
    ) -> Link | None:
        """Pause somebody, let them go on, send them away for good, or make a new link for them."""
        found = served.access.person(name)
        if found is None:
            raise Refused(404, "there is nobody of that name")
        if verb == "invite":
            return await _invite(served, request, name, found.role)
        if verb == "revoke" and name == who.name:
            raise Refused(409, "you cannot revoke yourself: nobody could go on")
        states: Json = {"pause": "paused", "resume": "active", "revoke": "revoked"}
        try:
            await served.record(served.access.change(name, states[verb]))
        except ValueError as error:
            raise Refused(409, str(error)) from None
        return None


def _add_project(router: APIRouter) -> None:
    @router.post("/api/admin/project", status_code=204, responses=errors(401, 413, 415, 507))
    async def project(sent: api.Project, who: Admin, served: Served) -> None:
        """Change how many people each question goes to."""
        await served.set_overlap(sent.overlap, who.name)

    @router.post("/api/admin/guideline", responses=errors(401, 413, 415, 507))
    async def guideline(sent: api.NewGuideline, who: Admin, served: Served) -> api.Guideline:
        """Write the guideline anew."""
        return await served.set_guideline(sent.text, who.name)


async def _invite(served: Service, request: Request, name: str, role: Any) -> Link:
    """A link for somebody, under the address by which the admin came."""
    try:
        token, events = served.access.invite(name, role)
    except ValueError as error:
        raise Refused(422, str(error)) from None
    await served.record(events)
    origin = request.headers.get("origin") or f"{request.url.scheme}://{request.headers['host']}"
    return Link(link=f"{origin}/#{token}")


def _overview(served: Service) -> Overview:
    overlap, counts = served.desk.policy.overlap, served.desk.counts()
    with served.store.log.reading() as connection:
        figures = served.dashboard.figures(connection, overlap)
    clips = served.clips.counts() if served.clips is not None else {}
    health = Health(
        store=served.trouble,
        sequence=served.seq,
        queue=served.writer.waiting,
        clips=clips,
        uptime_seconds=served.clock() - served.begun,
    )
    return Overview(
        page=served.terms.page,
        leased=counts.leased,
        overlap=overlap,
        guideline=served.guideline,
        health=health,
        exports=list(_exports(served)),
        **vars(figures),
    )


def _exports(served: Service) -> dict[str, str]:
    """The forms that are offered, and how their files end: demonstrations where people are asked for some."""
    kind = named(served.terms.page.kind)
    shown = {} if served.terms.page.ask == "judge" else {"demonstrations": kind.shown_file}
    return shown | dict(kind.exports)


def _export(served: Service, name: str) -> tuple[Path, Exported]:
    """Write an export into a temporary folder of its own, from a store that is only read; folders are zipped."""
    from prefrl.exchange.ports import export

    folder = Path(tempfile.mkdtemp(prefix="prefrl-export-"))
    path = folder / f"{name}{_exports(served)[name]}"
    try:
        with Store(served.store.folder, write=False) as store:
            done = export(store, path, name)
        return Path(shutil.make_archive(str(path), "zip", path)) if path.is_dir() else path, done
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
