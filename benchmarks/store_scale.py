"""A store with many labels: how long does it take to open, and how long until a person has the next question?

python benchmarks/store_scale.py [--short]

1,000,000 answers to 100,000 queries over 100,000 responses (short: 50,000 and 5,000), given out and filed through the
log as the server does. Then, five times: open the store for writing with the service that hands out questions, all of
which are still open; and 1,000 times: ask the service for the next question of one of 50 people, as the server does
for `POST /api/assignments`. No peer: the numbers are compared with targets (2 s to open, p95 of 50 ms).
"""

from __future__ import annotations

import argparse
import asyncio
import json
import shutil
import tempfile
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.judgements import Comparison
from prefrl.page import api
from prefrl.page.questions import Policy, Terms
from prefrl.page.service import Service
from prefrl.storage.log import row
from prefrl.store import Store
from prefrl.types import Query, Response

PEOPLE = 50
OVERLAP = 20
"""More than any query has answers: all are open, and who has answered which must be known of all."""
ASKED = 1000
TARGET_S = 2.0
"""No peer: it is compared with the target."""
TERMS = Terms(
    page=api.Page(
        title="replies",
        question="Which is better?",
        kind="text",
        strength=True,
        markdown=False,
        minimum_watched=0.0,
        break_minutes=0.0,
        ui_version="0",
    ),
    policy=Policy(OVERLAP, lease_seconds=600.0),
    strengths={"slight": 0.73, "clear": 0.88, "much": 0.95},
)


def fill(folder: Path, queries: int, answers: int) -> None:
    """Pairs of responses to prompts, the same number of answers to each, every one of another person."""
    texts = [
        Response(f"prompt {i // 10}", f"response {i}, of about the usual length of a short reply")
        for i in range(queries)
    ]
    pairs = [Query((texts[i], texts[i - i % 10 + (i + 1) % 10])) for i in range(queries)]
    with Store[Response](folder) as store:
        for i in range(0, queries, 10_000):
            store.ask(pairs[i : i + 10_000])
        with store.log.transaction() as tx:
            people = [f"person {k}" for k in range(PEOPLE)]
            tx.extend([row(f"annotator:{n}", "annotator", actor=n, body={"role": "annotator"}) for n in people])
        for k in range(answers // queries):
            for i in range(0, queries, 10_000):
                _answer(store, [(q.id, people[(j + k) % PEOPLE]) for j, q in enumerate(pairs[i : i + 10_000], i)])


def _answer(store: Store[Response], work: list[tuple[str, str]]) -> None:
    """Assignments and their answers, as the server files them, but many to a transaction."""
    with store.log.transaction() as tx:
        ids = [uuid.uuid4().hex for _ in work]
        given = {"shown": [0, 1], "purpose": "label", "guideline": ""}
        tx.extend([row(id, "assign", query, name, given) for id, (query, name) in zip(ids, work, strict=True)])
        for id, (query, name) in zip(ids, work, strict=True):
            about = {"submission": uuid.uuid4().hex, "digest": "", "assignment": id, "outcome": "first"}
            store.put(tx, Comparison(query, 1.0, name, (0, 1)), about)


def measure(folder: Path) -> tuple[list[float], list[float]]:
    """Seconds of each opening, and milliseconds until each next question; the answers in between are not timed."""
    opened = []
    for _ in range(5):
        begin = time.perf_counter()
        with Store[Response](folder) as store:
            service = Service(store, TERMS)
            service.open()
            opened.append(time.perf_counter() - begin)
            service.close()
    with Store[Response](folder) as store:
        service = Service(store, TERMS)
        service.open()
        try:
            return opened, asyncio.run(_next_questions(service))
        finally:
            service.close()


async def _next_questions(service: Service) -> list[float]:
    asked = []
    for i in range(ASKED):
        begin, name = time.perf_counter(), f"person {i % PEOPLE}"
        (given,) = await service.assign(name, 1)
        asked.append(1000 * (time.perf_counter() - begin))
        answer = api.Answer(submission_id=uuid.uuid4().hex, assignment_id=given.assignment_id, outcome="first")
        await service.answer(name, answer)
    return asked


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--keep", type=Path, help="Make the store there, or use the one that is there.")
    args = parser.parse_args()
    queries, answers = (5_000, 50_000) if args.short else (100_000, 1_000_000)
    folder = args.keep or Path(tempfile.mkdtemp())
    if not (folder / "store.db").exists():
        begin = time.perf_counter()
        fill(folder, queries, answers)
        print(f"filled in {time.perf_counter() - begin:.0f} s, {(folder / 'store.db').stat().st_size / 2**20:.0f} MiB")
    opened, asked = measure(folder)
    print(f"open: {sorted(round(s, 2) for s in opened)} s")
    result: dict[str, Any] = {
        "name": "store_scale",
        "unit": "s to open",
        "ours": round(float(np.median(opened)), 3),
        "peer": TARGET_S,
        "ratio": round(TARGET_S / float(np.median(opened)), 3),
        "spread": [round(min(opened), 3), round(max(opened), 3)],
        "labels": answers,
        "open_s": round(float(np.median(opened)), 3),
        "p50_ms": round(float(np.percentile(asked, 50)), 2),
        "p95_ms": round(float(np.percentile(asked, 95)), 2),
        "equal_work": True,
        "short": args.short,
    }
    print(json.dumps(result))
    if args.keep is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
