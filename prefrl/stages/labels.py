"""Labels on their own: ask queries and have them answered."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.config import Config
from prefrl.protocols import Attended, Labeler, control, text
from prefrl.rundir import RunError, Saved, saved_config
from prefrl.sample.graded import graded
from prefrl.seeding import streams
from prefrl.stages.policies import load_policy
from prefrl.storage.checkpoints import load_state
from prefrl.storage.files import read_lines, write_file
from prefrl.store import Store
from prefrl.types import Query, Response

LABELS = "labels.json"
"""What a folder of answers alone has been asked and told, for its report."""
Tell = Callable[[str], None]
"""How a person is told something while a stage goes on."""


def label(
    config: Config,
    folder: Path,
    policy: Saved | None = None,
    given: Path | None = None,
    tell: Tell = lambda _: None,
    policies: Sequence[Path] = (),
) -> dict[str, int]:
    """Ask `loop.labels` queries in the store of a folder, and have the labeler answer them; returns the counts.

    Candidates come from the starting policy, from a run's `policy`, from a file of `given` responses, or from
    `policies` of control (`load_policy`), which every query then mixes; the selector is not asked. Calling it again on
    the same folder goes on where it stopped, and asks more if `loop.labels` is higher. Raises `RunError` for the folder
    of a run, whose labels are its own.
    """
    if (folder / "checkpoints").exists():
        raise RunError(f"{folder} holds a run, which asks for its own labels: choose another folder")
    with Store(folder) as store:
        loop = config.build(store)
        for note in config.notes():
            tell(note)
        _keep_config(config, folder)  # what cannot be built is not kept: a mistake can be corrected in the same folder
        if policy is not None:
            loop.learner.load(load_state(policy.folder, "learner"))
            loop.reward.load(load_state(policy.folder, "reward"))
        asked = store.counts()["asked"]
        if given:
            store.ask(read_queries(given, loop.task))
        elif policies:
            queries = graded(
                {str(path): load_policy(path) for path in policies},
                control(loop.task, "--policy gives segments of control"),
                loop.candidates,
                config.loop.labels - asked,
                streams(config.seed, 1 + asked).sample,
            )
            store.ask(queries)
        else:
            loop.ask(config.loop.labels - asked, streams(config.seed, 1 + asked))
        with attended(loop.labeler, store, tell):
            loop.labeler.answer(store, streams(config.seed, 1).label)
        counts = store.counts()
        write_file(folder / LABELS, json.dumps(counts).encode())
        return counts


def serve(folder: Path, overrides: Sequence[str] = (), tell: Tell = lambda _: None) -> dict[str, int]:
    """Have people answer what was asked in the store of a folder, until nothing is left; returns the counts.

    The settings of the page are the folder's own, if it has any. Raises `RunError` where there is no store, and
    `StoreError` where a run that goes on has it.
    """
    if not (folder / "store.db").exists() and not (folder / "store.url").exists():
        raise RunError(f"{folder} holds no store: expected the folder of a run, or of `prefrl label`")
    saved_config(folder)  # says what is missing, if it is
    config = Config.reopen(folder / "config.yaml", ["labeler.kind=web", *overrides])
    with Store(folder) as store:
        if not store.open_queries():
            tell(f"everything is answered in {folder}; new questions: prefrl label {folder} --serve --out ANOTHER")
        labeler = config.build_labeler(config.build_task())
        with attended(labeler, store, tell):
            labeler.answer(store, streams(config.seed, 1).label)
        return store.counts()


@contextmanager
def attended(labeler: Labeler, store: Store, tell: Tell) -> Iterator[None]:
    """Have open what a labeler's people come to, if there is such a thing; nothing more will be asked."""
    if not isinstance(labeler, Attended):
        yield
        return
    try:
        for note in labeler.open(store, fixed=True):
            tell(note)
        yield
    finally:
        labeler.close()


def read_queries(path: Path, task: Any) -> list[Query[Response]]:
    """Queries from JSON lines `{"prompt": ..., "responses": [...]}`. Raises `ValueError` with the row's number."""
    text(task, f"{path} holds responses to prompts")
    queries = []
    for number, line in enumerate(read_lines(path), 1):
        try:
            queries.append(Query(tuple(with_gold(_responses(json.loads(line)), task))))
        except ValueError as error:
            raise ValueError(f"{path}: row {number}: {error}") from error
    if not queries:
        raise ValueError(f"{path}: expected at least one row, got none")
    return queries


def _responses(row: Any) -> list[Response]:
    """The responses of one row; gold and tokens are not known yet."""
    prompt, texts = (row.get("prompt"), row.get("responses")) if isinstance(row, dict) else (None, None)
    if not isinstance(prompt, str) or not isinstance(texts, list) or not all(isinstance(t, str) for t in texts):
        raise ValueError(f'expected {{"prompt": string, "responses": [strings]}}, got {row!r}')
    if len(texts) < 2:
        raise ValueError(f"a query needs at least 2 responses to compare, got {len(texts)}")
    return [Response(prompt, text) for text in texts]


def with_gold(responses: list[Response], task: Any) -> list[Response]:
    """Attach the hidden gold, for oracles."""
    gold = task.gold(responses)
    return [replace(r, gold=np.array([g])) for r, g in zip(responses, gold, strict=True)]


def _keep_config(config: Config, folder: Path) -> None:
    """Write the settings beside a store, or see that it was made for the same task. The first ones stay."""
    path = folder / "config.yaml"
    if not path.exists():
        write_file(path, config.dump().encode())
    elif saved_config(folder).task != config.task:
        raise RunError(f"{folder} holds labels for another task: choose another folder")
