"""Is anything lost, or stored twice, when the server is killed while people label?

python benchmarks/label_kill.py [--short] [--kills N] [--people N]

A server on a store of text pairs, in a process of its own, and 50 people in another one, who take questions and
answer them; two different people are asked each question, and some questions come back to the same person. The server
is killed with SIGKILL, 1,000 times (short: 25), at a random time 0.05 to 1.5 s after somebody had a response (one time
in ten: after people could come), and started again on the same port. A person whose answer was not acknowledged sends
it again, with the same submission id, until it is; some answers are sent twice at the same moment, and some questions
are answered again from "another tab".

At the end the log is read. `lost`: acknowledged answers that are not in it exactly once, with the number that was
acknowledged. `duplicates`: assignments with two answers, and questions that one person answered twice. `faults`: all
else that must not be: a session or an assignment that did not outlive a restart; an answer said to be a repetition
though it was not on disk before, or said to be new though it was; an answer with another number the second time; any
status but 200; a connection that ended while the server lived. `chain`: whether `prefrl verify` finds the store whole.

So that a thousand kills take less than an hour, each life of the server is forked from a process that has imported
everything; `open_p95_s` is from the opening of the store until people can come. `cold_start_s`, the median of five new
Python processes on the store at the end, has the imports too (target: 2 s). No peer.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import secrets
import signal
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from labelling import Browser, Server, admit, free_port

from prefrl.storage.maintenance import verify_store
from prefrl.storage.projection import ANSWERS
from prefrl.store import Store

AHEAD = 2
"""Questions that one person holds."""
COLD = 5
"""Starts of a new Python process at the end."""
OPEN = 2000
"""Questions that are open after each start: more than are answered until the next kill."""
AGAIN = 0.1
"""Seconds until somebody tries again."""
THINK = 0.3
"""Mean seconds between a question and its answer."""
AT_ONCE = 0.1
"""Share of the server's lives in which nobody need have had a response."""
TWICE, OTHER_TAB = 0.1, 0.05
"""Shares of answers that are sent twice at once, and of questions that are answered again."""


@dataclass
class Trial:
    """One store, its server, and what people were told."""

    port: int
    up: bool = False
    over: bool = False
    heads: list[int] = field(default_factory=list)
    """The newest event when the server was started for the n-th time."""
    kills: int = 0
    heard: asyncio.Event = field(default_factory=asyncio.Event)
    """Whether anybody had a response in this life."""
    told: dict[str, int] = field(default_factory=dict)
    """Submission id -> number, as acknowledged."""
    faults: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def life(self) -> int | None:
        """Which of the server's lives this is; None until it is known what was on disk when it began."""
        return self.kills if len(self.heads) > self.kills else None


@dataclass
class Tab:
    """A person's browser, and the life of the server that it is connected to."""

    trial: Trial
    browser: Browser
    life: int = -1
    _opened: int = 0

    async def post(self, path: str, body: dict[str, Any]) -> dict[str, Any] | None:
        """What came back; None where nothing did. Anything but 200 is a fault."""
        trial, up, life = self.trial, self.trial.up, self.trial.life
        if life is None:
            return None
        try:
            await self.browser.connect()
            if self.browser.opened != self._opened:
                self.life, self._opened = life, self.browser.opened
            status, said = await self.browser.post(path, body)
        except OSError as error:
            self.browser.close()
            if up and trial.up and life == trial.life == self.life:
                trial.faults[f"the connection ended while the server lived: {error}"] += 1
            return None
        if status == 200:
            trial.heard.set()
            return said
        trial.faults[f"{path}: {status} {said.get('error')}"] += 1
        return None


@dataclass
class Person:
    """Takes questions and answers them, whatever happens to the server."""

    trial: Trial
    tabs: tuple[Tab, Tab]
    rng: random.Random
    held: list[str] = field(default_factory=list)
    """Assignments that were received, and not answered."""

    async def work(self) -> None:
        while not self.trial.over:
            if not self.held:
                await self._take()
            await asyncio.sleep(self.rng.expovariate(1 / THINK))
            if self.held and not self.trial.over:
                life = self.tabs[0].life
                await self._answer(self.held[0])
                if self.tabs[0].life != life:
                    await self._take()
        for tab in self.tabs:
            tab.browser.close()

    async def _take(self) -> None:
        """Ask for questions; those that are held must be among them, first and in their order."""
        found = await self.tabs[0].post("/api/assignments", {"want": AHEAD})
        if found is None:
            await asyncio.sleep(AGAIN)
            return
        given = [one["assignment_id"] for one in found["assignments"]]
        if given[: len(self.held)] != self.held:
            self.trial.faults["an assignment did not outlive a restart"] += 1
        self.held = given

    async def _answer(self, assignment: str) -> None:
        """Send an answer until it is acknowledged."""
        outcome = self.rng.choice(("first", "second", "tie", "incomparable", "skip"))
        body = {"submission_id": secrets.token_hex(16), "assignment_id": assignment, "outcome": outcome}
        doubled = self.rng.random() < TWICE
        while not (receipts := await self._send(body, doubled)):
            self.trial.counts["sent again"] += 1
            await asyncio.sleep(AGAIN)
            if self.trial.over and not self.trial.up:
                return
        self._check(body["submission_id"], receipts, doubled)
        self.held.remove(assignment)
        if self.rng.random() < OTHER_TAB:
            await self._answer_elsewhere(assignment, receipts[0]["seq"])

    async def _send(self, body: dict[str, Any], doubled: bool) -> list[dict[str, Any]]:
        """What was answered, if anything."""
        found = await asyncio.gather(*(tab.post("/api/answers", body) for tab in self.tabs[: 1 + doubled]))
        return [one for one in found if one is not None]

    def _check(self, submission: str, receipts: list[dict[str, Any]], doubled: bool) -> None:
        trial, seq = self.trial, receipts[0]["seq"]
        trial.told[submission] = seq
        trial.counts["answers"] += 1
        if any(one["seq"] != seq for one in receipts):
            trial.faults["two numbers for one submission"] += 1
        fresh = sum(not one["duplicate"] for one in receipts)
        if not doubled:
            known = seq <= trial.heads[self.tabs[0].life]
            trial.counts["found on disk"] += known
            if fresh == known:
                trial.faults["a repetition was said to be new, or a new answer a repetition"] += 1
        elif fresh > 1:
            trial.faults["one submission was new twice"] += 1

    async def _answer_elsewhere(self, assignment: str, seq: int) -> None:
        """A second answer to a question changes nothing, and is told the first one's number."""
        body = {"submission_id": secrets.token_hex(16), "assignment_id": assignment, "outcome": "tie"}
        receipt = await self.tabs[1].post("/api/answers", body)
        if receipt not in (None, {"seq": seq, "duplicate": True}):
            self.trial.faults["a second answer to a question counted"] += 1


async def run(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """All kills, the last one when all is said, and some cold starts; returns the numbers."""
    trial, tokens = Trial(free_port()), admit(folder, given.people)
    work = [asyncio.create_task(_person(trial, i, token).work()) for i, token in enumerate(tokens)]
    options = ["--overlap", 2, "--open", OPEN, "--repeats", 0.05, "--rate", 1e6]
    server = await Server.start(folder, trial.port, *options, "--lives")
    try:
        opens = await live_and_die(trial, server, given.kills, work)
    finally:
        await server.end()
    starts = [await cold_start(folder, trial.port, options) for _ in range(COLD)]
    return summary(folder, trial) | {
        "open_p95_s": round(float(np.percentile(opens, 95)), 3),
        "cold_start_s": round(float(np.median(starts)), 2),
    }


async def live_and_die(trial: Trial, server: Server, kills: int, work: list[asyncio.Task[None]]) -> list[float]:
    """One life after the other; in the last one people come to an end. Returns how long each took to begin."""
    rng, opens = random.Random(0), []
    for life in range(kills):
        process = await server.live()
        try:
            trial.heard.clear()
            trial.heads.append(await server.said("head"))
            opens.append(await server.said("seconds"))
            trial.up = True
            if rng.random() > AT_ONCE:
                await asyncio.wait_for(trial.heard.wait(), 60)
            await asyncio.sleep(rng.uniform(0.05, 1.5))
            trial.over = life == kills - 1
            if trial.over:
                await asyncio.wait_for(asyncio.gather(*work), 60)
        finally:
            trial.up = False
            trial.kills += 1
            os.kill(process, signal.SIGKILL)
        await server.said("ended")
        if (life + 1) % 10 == 0:
            print(f"{life + 1} kills, {dict(trial.counts)}, faults: {dict(trial.faults)}", flush=True)
    return opens


async def cold_start(folder: Path, port: int, options: list[object]) -> float:
    """Seconds from the start of a new process until people can come."""
    begin = time.perf_counter()
    server = await Server.start(folder, port, *options)
    try:
        await server.said("head")
        await server.said("seconds")
        return time.perf_counter() - begin
    finally:
        await server.end()


def _person(trial: Trial, number: int, token: str) -> Person:
    one, other = (Tab(trial, Browser(trial.port, token)) for _ in range(2))
    return Person(trial, (one, other), random.Random(number))


def summary(folder: Path, trial: Trial) -> dict[str, Any]:
    """What people were told, against what is in the log."""
    stored: dict[str, list[int]] = {}
    answered: Counter[tuple[str, str]] = Counter()
    with Store[Any](folder, write=False) as store:
        for one in store.events():
            about = one["body"].get("about") or {}
            if "submission" in about:
                stored.setdefault(about["submission"], []).append(one["seq"])
                answered["assignment", about["assignment"]] += 1
            if one["kind"] in ANSWERS:
                answered[one["subject"], one["actor"]] += 1
    verified = verify_store(folder)
    for fault in verified.faults:
        print(fault)
    lost = sum(stored.get(submission) != [seq] for submission, seq in trial.told.items())
    return {
        "name": "label_kill",
        "unit": "acknowledged answers that are not in the log",
        "ours": lost,
        "peer": 0,
        "ratio": None,
        "spread": None,
        "equal_work": True,
        "kills": trial.kills,
        "answers": trial.counts["answers"],
        "sent_again": trial.counts["sent again"],
        "found_on_disk": trial.counts["found on disk"],
        "lost": lost,
        "duplicates": sum(count - 1 for count in answered.values()),
        "faults": trial.faults.total(),
        "fault_kinds": dict(trial.faults),
        "chain": verified.ok,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="25 kills: about a minute")
    parser.add_argument("--kills", type=int)
    parser.add_argument("--people", type=int, default=50)
    given = parser.parse_args()
    given.kills = given.kills or (25 if given.short else 1000)
    with tempfile.TemporaryDirectory() as folder:
        result = asyncio.run(run(Path(folder), given))
    print(json.dumps(result | {"short": given.short}))


if __name__ == "__main__":
    main()
