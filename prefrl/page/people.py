"""Who is asking: the dependencies of the routes, and the failures they declare."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from prefrl.page import api
from prefrl.page.access import Person
from prefrl.page.security import Refused
from prefrl.page.service import Service

ALWAYS = (400, 403, 408, 429, 500, 503)
"""What any request may be answered with: the guard says it, or the disk."""
_cookie = APIKeyCookie(name="prefrl-STORE", description="STORE is `store` of /api/me.", auto_error=False)
_bearer = HTTPBearer(auto_error=False)


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The failures that a route declares, beside those that any may meet."""
    return {status: {"model": api.Failure} for status in sorted({*statuses, *ALWAYS})}


async def service_of(request: Request) -> Service:
    found: Service = request.app.state.service
    return found


def cookie_name(served: Service) -> str:
    """Of the session's cookie. A browser sends a host's cookies to all its ports: each store has one of its own."""
    return f"prefrl-{served.store_id}"


async def viewer(
    request: Request, served: Annotated[Service, Depends(service_of)], _: Annotated[None, Depends(_cookie)]
) -> Person:
    """The person whose session the cookie holds. Raises `Refused`."""
    token = request.cookies.get(cookie_name(served))
    found = served.access.who(token, "session") if token else None
    if found is None:
        raise Refused(401, "you are not logged in: open the link that you were given")
    return found


async def person(served: Annotated[Service, Depends(service_of)], who: Annotated[Person, Depends(viewer)]) -> Person:
    """The same, if this person does not ask too often. A clip takes many requests, and is left out."""
    served.requests.take(who.name)
    return who


async def admin(who: Annotated[Person, Depends(person)]) -> Person:
    """The same, if it is an admin."""
    if who.role != "admin":
        raise Refused(403, "this is for admins")
    return who


async def trainer(
    served: Annotated[Service, Depends(service_of)],
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Person:
    """The program whose token the header Authorization holds. Raises `Refused`."""
    found = served.access.who(credentials.credentials, "invite") if credentials else None
    if found is None:
        raise Refused(401, "expected the header Authorization: Bearer TOKEN, with the token of a trainer")
    if found.role != "trainer":
        raise Refused(403, "this token is a person's: labels are read with a trainer's")
    served.requests.take(found.name)
    return found
