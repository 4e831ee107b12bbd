"""How long do people wait when many label at once?

python benchmarks/label_load.py [--short] [--people N] [--labels N] [--overlap N] [--think SECONDS]

The server in one process; in another one 100 people who give about 200 answers each (short: 30 and 20), three people to
each question, on a store of text pairs. Everyone holds up to four questions as the page does: after an answer is
acknowledged, more are fetched, and the next answer follows after a time to think, drawn from an exponential
distribution with a mean of 1 s (0: at once). `p50_ms` to `p99_ms` are what a person waits for `POST /api/answers`,
measured in the client, its own time included; `assignments_p95_ms` is the same for `POST /api/assignments`. No peer:
the numbers are compared with targets (p95 under 250 ms, p99 under 1 s, no errors, each question answered by exactly as
many different people as were wanted). `server_cpu_ms` is what the server computes for one label.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import secrets
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from labelling import DEFAULT_RATE, Browser, Server, admit, cpu_seconds, free_port

from prefrl.storage.projection import ANSWERS
from prefrl.store import Store

TARGET_MS = 250.0
"""No peer: 95 % of the answers are compared with it."""
AHEAD = 4
"""Questions that one person holds."""


@dataclass
class Load:
    """What the people of one run share."""

    port: int
    think: float
    wanted: int
    """Answers of all together."""
    answered: int = 0
    answers: list[float] = field(default_factory=list)
    """Seconds that each answer took."""
    assignments: list[float] = field(default_factory=list)
    errors: Counter[str] = field(default_factory=Counter)
    cpu: tuple[float, int] = (0.0, 0)
    """What the server had computed when last looked at, in seconds, and the answers until then."""

    async def person(self, name: str, token: str) -> None:
        """Answer until there is nothing left."""
        rng, browser = random.Random(name), Browser(self.port, token)
        await asyncio.sleep(rng.random() * self.think)
        while questions := await self._questions(browser):
            await asyncio.sleep(rng.expovariate(1 / self.think) if self.think else 0)
            outcome = rng.choice(("first", "second", "tie"))
            body = {"submission_id": secrets.token_hex(16), "assignment_id": questions[0], "outcome": outcome}
            receipt = await self._post(browser, "/api/answers", body, self.answers)
            if receipt is None:
                break
            self.answered += not receipt["duplicate"]
        browser.close()

    async def watch(self, pid: int) -> None:
        """Keep `cpu` up while the server lives: it ends with the last answer."""
        while used := cpu_seconds(pid):
            self.cpu = used, self.answered
            await asyncio.sleep(0.2)

    async def _questions(self, browser: Browser) -> list[str]:
        """The assignments that this person holds; none when all is done."""
        if self.answered >= self.wanted:
            return []
        found = await self._post(browser, "/api/assignments", {"want": AHEAD}, self.assignments)
        return [one["assignment_id"] for one in found["assignments"]] if found else []

    async def _post(
        self, browser: Browser, path: str, body: dict[str, Any], took: list[float]
    ) -> dict[str, Any] | None:
        begin = time.perf_counter()
        try:
            status, said = await browser.post(path, body)
        except ConnectionError as error:
            if self.answered < self.wanted:  # a server that has all answers ends
                self.errors[str(error)] += 1
            return None
        took.append(time.perf_counter() - begin)
        if status == 200:
            return said
        self.errors[f"{path} {status} {said.get('error')}"] += 1
        return None


async def run(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """One server, all people; returns the numbers."""
    queries = -(-given.people * given.labels // given.overlap)
    tokens = admit(folder, given.people)
    load = Load(free_port(), given.think, queries * given.overlap)
    rate = DEFAULT_RATE if given.think else 1e6
    options = ["--overlap", given.overlap, "--open", queries, "--rate", rate]
    server = await Server.start(folder, load.port, *options)
    try:
        await server.said("head")
        await server.said("seconds")
        begin, before = time.perf_counter(), cpu_seconds(server.process.pid)
        watch = asyncio.create_task(load.watch(server.process.pid))
        await asyncio.gather(*(load.person(f"person {i}", token) for i, token in enumerate(tokens)))
        seconds = time.perf_counter() - begin
        watch.cancel()
    finally:
        await server.end()
    for error, count in load.errors.items():
        print(f"{count} x {error}")
    found = percentiles(load.answers, "")
    return {
        "name": "label_load",
        "unit": "ms from sending an answer to its acknowledgement, 95 %",
        "ours": found["p95_ms"],
        "peer": TARGET_MS,
        "ratio": round(TARGET_MS / found["p95_ms"], 3),
        "spread": [found["p50_ms"], found["p99_ms"]],
        "equal_work": True,
        **found,
        **percentiles(load.assignments, "assignments_"),
        "errors": load.errors.total(),
        "throughput": round(load.answered / seconds, 1),
        "server_cpu_ms": round(1000 * (load.cpu[0] - before) / max(load.cpu[1], 1), 2),
        "people": given.people,
        "labels": load.answered,
        "overlap": given.overlap,
        "think_s": given.think,
        **audit(folder, given.overlap),
    }


def percentiles(seconds: list[float], prefix: str) -> dict[str, float]:
    return {f"{prefix}p{p}_ms": round(1000 * float(np.percentile(seconds, p)), 1) for p in (50, 95, 99)}


def audit(folder: Path, overlap: int) -> dict[str, int]:
    """How many questions have answers of any other number of different people, and how many had one person twice."""
    asked: list[str] = []
    people: dict[str, list[str]] = {}
    with Store[Any](folder, write=False) as store:
        for one in store.events():
            if one["kind"] == "query":
                asked.append(one["id"])
            elif one["kind"] in ANSWERS:
                people.setdefault(one["subject"], []).append(one["actor"])
    twice = sum(len(names) > len(set(names)) for names in people.values())
    return {"wrong_overlap": sum(len(set(people.get(id, ()))) != overlap for id in asked), "twice": twice}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="30 people, 20 answers each: under a minute")
    parser.add_argument("--people", type=int)
    parser.add_argument("--labels", type=int, help="answers of each")
    parser.add_argument("--overlap", type=int, default=3)
    parser.add_argument("--think", type=float, default=1.0, help="mean seconds")
    given = parser.parse_args()
    given.people = given.people or (30 if given.short else 100)
    given.labels = given.labels or (20 if given.short else 200)
    with tempfile.TemporaryDirectory() as folder:
        result = asyncio.run(run(Path(folder), given))
    print(json.dumps(result | {"short": given.short}))


if __name__ == "__main__":
    main()
