"""What a trainer in another process may do: ask about texts, and read what was asked and answered."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from prefrl import types
from prefrl.kinds import RESPONSES
from prefrl.page import api, records
from prefrl.page.access import Person
from prefrl.page.people import errors, service_of, trainer
from prefrl.page.security import Refused
from prefrl.page.service import Service
from prefrl.storage.tables import canonical
from prefrl.types import Json

MOST_LABELS, MOST_QUERIES = 10_000, 1000
"""In one answer."""
Trainer = Annotated[Person, Depends(trainer)]
Served = Annotated[Service, Depends(service_of)]
After = Annotated[int, Query(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=100_000)]


class NewQuery(api.Body):
    """Responses to one prompt, to be compared."""

    prompt: Text
    responses: list[Text] = Field(min_length=2, max_length=8)
    """Different ones, as many as a page can rank."""


class NewQueries(api.Body):
    queries: list[NewQuery] = Field(min_length=1, max_length=200)


class Filed(api.Plain):
    ids: list[str]
    """Of the queries, as they were sent: the sha256 of what they ask, so that asking twice is asking once."""


class Candidate(api.Plain):
    id: str
    prompt: str | None = None
    """Of texts only, as is the text."""
    text: str | None = None


class Asked(api.Plain):
    seq: int
    """The number of its event."""
    id: str
    candidates: list[Candidate]
    """In the query's own order, which answers keep to."""


class AskedQueries(api.Plain):
    queries: list[Asked]


def trainer_routes() -> APIRouter:
    router = APIRouter()

    @router.put("/api/queries", responses=errors(401, 409, 413, 415, 422, 507))
    async def ask(sent: NewQueries, who: Trainer, served: Served) -> Filed:
        """Ask about texts. What was asked before is left alone."""
        if served.terms.page.kind != RESPONSES.name:
            raise Refused(409, "this project judges clips, which only its own run can ask about")
        if served.terms.shows is not None:
            raise Refused(409, "this project asks people to rewrite single responses, which its own run chooses")
        queries = [_query(one) for one in sent.queries]
        await served.ask(queries)
        return Filed(ids=[one.id for one in queries])

    @router.get("/api/queries", response_model=AskedQueries, responses=errors(401))
    async def asked(
        who: Trainer, served: Served, after_seq: After = 0, limit: Annotated[int, Query(ge=1, le=MOST_QUERIES)] = 100
    ) -> Response:
        """What was asked after an event's number, with the texts, oldest first; check questions not among them."""
        found = await run_in_threadpool(_asked, served, after_seq, limit)
        # Escaped, so that texts with half a surrogate pair come out as they went in.
        return Response(canonical(found.model_dump()), media_type="application/json")

    @router.get("/api/labels", responses=errors(401))
    async def labels(
        who: Trainer, served: Served, after_seq: After = 0, limit: Annotated[int, Query(ge=1, le=MOST_LABELS)] = 1000
    ) -> dict[str, list[Json]]:
        """Answers and retractions after an event's number, oldest first."""

        def read() -> list[Json]:
            with served.store.log.reading() as connection:
                return records.judgements_after(connection, after_seq, limit)

        return {"labels": await run_in_threadpool(read)}

    return router


def _query(one: NewQuery) -> types.Query[types.Response]:
    try:
        return types.Query(tuple(types.Response(one.prompt, text) for text in one.responses))
    except ValueError as error:
        raise Refused(422, str(error)) from None


def _asked(served: Service, after: int, limit: int) -> AskedQueries:
    with served.store.log.reading() as connection:
        found = records.queries_after(connection, after, limit)
        candidates = records.candidates(connection, [id for _, id in found])
    return AskedQueries(queries=[Asked(seq=seq, id=id, candidates=_told(candidates[id])) for seq, id in found])


def _told(candidates: list[Json]) -> list[Candidate]:
    return [Candidate(id=one["id"], prompt=one.get("prompt"), text=one.get("text")) for one in candidates]
