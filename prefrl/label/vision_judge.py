"""An AI judge of pictures: a vision-language model behind an OpenAI-compatible address, asked in both orders.

Variant: the position swap of Zheng et al. 2023, section 3.4. Pictures go as data URLs of PNG, enlarged as people see
them. What is no answer is a refusal, and what comes too late, after `retries`, counts as one: the query is skipped.
"""

from __future__ import annotations

import base64
import http.client
import io
import json
import math
import re
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, cast

import numpy as np
from PIL import Image
from pydantic import Field, field_validator

from prefrl.components import ConfigError, Settings
from prefrl.label.both_orders import Verdict, answer_open
from prefrl.protocols import PictureTask, Store, Task, pictures
from prefrl.types import Metrics, Picture, Query

LONGEST = 1_000_000
"""Bytes of a reply that are read at most."""
LEADS = "the|final|better|answer|picture|is"
"""Words that may stand before an answer, in capitals or not: `Answer: B`, `Picture A`, `The answer is B`."""


class VisionJudgeSettings(Settings):
    """Ask a vision-language model which picture is better, each pair in both orders."""

    kind: Literal["vision_judge"] = "vision_judge"
    name: str = Field("vision-judge", min_length=1)
    """Who answers; kept with every answer."""
    address: str = Field("http://127.0.0.1:8000/v1", pattern="^https?://")
    """Of a server with OpenAI's chat completions: what stands before `/chat/completions`."""
    model: str = "default"
    """The name by which the server knows its model."""
    key_file: Path | None = None
    """A file with the key that the server wants, where it wants one; only its place is kept with a run."""
    criterion: str = "Which picture fits the caption better?"
    """What is asked of the two pictures; the goal of the run where this is left as it is."""
    answers: tuple[str, str] = ("A", "B")
    """What the model says for the first and for the second picture shown."""
    reply_tokens: int = Field(8, ge=1)
    """The most tokens of a reply."""
    timeout_seconds: float = Field(60.0, gt=0)
    """How long one reply may take."""
    retries: int = Field(1, ge=0)
    """How often a question is asked again after it took too long, the connection broke, or the server failed."""
    pause_seconds: float = Field(1.0, ge=0)
    """How long to wait before a question is asked again; twice as long each further time."""
    at_once: int = Field(4, ge=1)
    """Questions that are under way at the same time."""

    @field_validator("answers")
    @classmethod
    def _differ(cls, answers: tuple[str, str]) -> tuple[str, str]:
        first, second = (answer.strip() for answer in answers)
        if not first or not second or first == second:
            raise ValueError(f"expected two answers that differ, neither empty, got {list(answers)}")
        return first, second

    def asking(self, goal: str) -> Self:
        own = self.criterion != type(self).model_fields["criterion"].default
        return self if own or not goal else self.model_copy(update={"criterion": goal})

    def build(self, task: Task) -> VisionJudge:
        """Raises `ConfigError` for a task of another kind, and for a key that cannot be read."""
        found = pictures(task, f"labeler kind {self.kind!r} looks at pictures")
        key = ""
        if self.key_file is not None:
            try:
                key = self.key_file.read_text(encoding="utf-8").strip()
            except (OSError, ValueError) as error:
                raise ConfigError(f"labeler.key_file: cannot be read: {error}") from error
        return VisionJudge(self, found, key)


@dataclass
class VisionJudge:
    """Answers every open query at once, with soft preferences: the mean over both orders."""

    settings: VisionJudgeSettings
    task: PictureTask
    key: str = field(default="", repr=False)
    metrics: Metrics = field(default_factory=dict)
    """What `prefrl.label.both_orders.bias` says of the last session."""

    @property
    def name(self) -> str:
        return self.settings.name

    def answer(self, store: Store[Picture], rng: np.random.Generator) -> None:
        """Nothing is drawn. Raises `ConfigError` where nobody answers there, or the server refuses the request."""

        def compare(some: Sequence[tuple[Query[Picture], int, int]]) -> list[Verdict]:
            return self.compare([(q.candidates[i], q.candidates[j]) for q, i, j in some])

        self.metrics = answer_open(store, self.name, compare)

    def compare(self, pairs: Sequence[tuple[Picture, Picture]]) -> list[Verdict]:
        """Judge pairs of pictures of one caption, each in both orders."""
        questions = [*pairs, *((b, a) for a, b in pairs)]
        with ThreadPoolExecutor(self.settings.at_once) as pool:
            first = list(pool.map(self._ask, questions))
        return [Verdict(x, 1 - y) for x, y in zip(first[: len(pairs)], first[len(pairs) :], strict=True)]

    def _ask(self, pair: tuple[Picture, Picture]) -> float:
        """1 where the first picture shown is said to be better, 0 where the second is; NaN for anything else."""
        question = self._question(*pair)
        for turn in range(self.settings.retries + 1):
            if turn:
                time.sleep(self.settings.pause_seconds * 2 ** (turn - 1))
            try:
                return read_reply(self._sent(question), self.settings.answers)
            except (urllib.error.URLError, TimeoutError, ConnectionError, http.client.HTTPException) as error:
                self._check_passing(error)
        return math.nan

    def _check_passing(self, error: Exception) -> None:
        """Raises `ConfigError` for what asking again will not mend."""
        address = self.settings.address
        if isinstance(error, urllib.error.HTTPError):
            if error.code < 500 and error.code not in (408, 429):
                said = error.read(300).decode("utf-8", "replace")
                raise ConfigError(f"labeler.address: the server refuses with {error.code}: {said}") from error
        elif isinstance(error, urllib.error.URLError):
            why = error.reason
            if not isinstance(why, TimeoutError | ConnectionError) or isinstance(why, ConnectionRefusedError):
                raise ConfigError(
                    f"labeler.address: nobody answers at {address} ({why}): start the server, or set its address"
                ) from error
        elif isinstance(error, http.client.InvalidURL):
            raise ConfigError(f"labeler.address: {address} is no address: {error}") from error

    def _question(self, first: Picture, second: Picture) -> dict[str, Any]:
        a, b = self.settings.answers
        asked = f"{self.settings.criterion} Answer with one letter, {a} or {b}."
        content = [
            {"type": "text", "text": f"The caption is between the quotes: {json.dumps(first.caption)}. Picture {a}:"},
            self._shown(first),
            {"type": "text", "text": f"Picture {b}:"},
            self._shown(second),
            {"type": "text", "text": asked},
        ]
        limits = {"max_tokens": self.settings.reply_tokens, "temperature": 0}
        return {"model": self.settings.model, "messages": [{"role": "user", "content": content}], **limits}

    def _shown(self, picture: Picture) -> dict[str, Any]:
        data = io.BytesIO()
        Image.fromarray(self.task.frames(picture)[0]).save(data, "PNG")
        address = "data:image/png;base64," + base64.b64encode(data.getvalue()).decode("ascii")
        return {"type": "image_url", "image_url": {"url": address}}

    def _sent(self, question: dict[str, Any]) -> object:
        headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {self.key}"} if self.key else {})
        address = f"{self.settings.address.rstrip('/')}/chat/completions"
        request = urllib.request.Request(address, json.dumps(question).encode(), headers)
        with urllib.request.urlopen(request, timeout=self.settings.timeout_seconds) as reply:
            said = reply.read(LONGEST)
            if reply.length and len(said) < LONGEST:  # with a limit, a short read passes for a whole one
                raise http.client.IncompleteRead(said, reply.length)
            try:
                return cast(object, json.loads(said))
            except ValueError as error:
                raise ConfigError(
                    f"labeler.address: what answers at {self.settings.address} does not speak JSON"
                ) from error


def read_reply(reply: object, answers: tuple[str, str]) -> float:
    """1 or 0 for a reply that is the first or the second answer, NaN for another.

    Punctuation may stand around it, and one of `LEADS` before it. What goes on is no answer: "A three is clearer in B".
    """
    try:
        said = cast(Any, reply)["choices"][0]["message"]["content"]
    except (TypeError, KeyError, IndexError):
        return math.nan
    if not isinstance(said, str):  # a model that refuses says nothing
        return math.nan
    lead = rf"[\W_]*(?:(?i:{LEADS})(?:[\W_]+|$))*"
    first, second = (re.fullmatch(rf"{lead}{re.escape(one)}[\W_]*", said) is not None for one in answers)
    return float(first) if first != second else math.nan
