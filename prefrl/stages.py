"""The stages on their own: collect labels, fit a reward model, improve a policy, evaluate one."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.checkpoints import load_state
from prefrl.components import Settings
from prefrl.config import Config
from prefrl.files import write_file
from prefrl.fit.trainer import fit
from prefrl.label.exchange import import_preferences
from prefrl.loop import Loop
from prefrl.rundir import RunError, Saved, open_saved, save_reward, saved_config
from prefrl.seeding import Streams, streams
from prefrl.store import Store
from prefrl.types import Evaluation, Fitted, Query, Response


def label(config: Config, folder: Path, policy: Saved | None = None, given: Path | None = None) -> dict[str, int]:
    """Ask `loop.labels` queries in the store of a folder, and have the labeler answer them; returns the counts.

    Candidates come from the starting policy, from a run's `policy`, or from a file of `given` responses. Calling it
    again on the same folder goes on where it stopped.
    """
    _keep_config(config, folder)
    with Store[Any](folder) as store:
        loop = config.build(store)
        if policy is not None:
            loop.learner.load(load_state(policy.folder, "learner"))
        rng = streams(config.seed, 1)
        if not store.counts()["asked"]:
            store.ask(read_queries(given, loop.task) if given else _sampled(loop, rng))
        loop.labeler.answer(store, rng.label)
        return store.counts()


def _sampled(loop: Loop[Any], rng: Streams) -> list[Query[Any]]:
    count = loop.settings.labels
    pool = loop.learner.sample(int(count * loop.candidates * loop.settings.pool), rng.sample)
    return loop.selector.select(pool, loop.reward, count, rng.select)


def read_queries(path: Path, task: Any) -> list[Query[Response]]:
    """Queries from JSON lines `{"prompt": ..., "responses": [...]}`. Raises `ValueError` with the row's number."""
    queries = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        try:
            row = json.loads(line)
            responses = [Response(str(row["prompt"]), str(text)) for text in row["responses"]]
            queries.append(Query(tuple(_with_gold(responses, task))))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: row {number}: expected a prompt and its responses: {error}") from error
    return queries


def _with_gold(responses: list[Response], task: Any) -> list[Response]:
    """Attach the hidden gold, for oracles."""
    gold = task.gold(responses)
    return [replace(r, gold=np.array([g])) for r, g in zip(responses, gold, strict=True)]


def fit_reward(config: Config, source: Path, out: Path) -> Fitted:
    """Fit a reward model on a folder's store, or on a file of prompt/chosen/rejected lines, and save it."""
    with tempfile.TemporaryDirectory() as scratch:
        from_file = source.is_file()
        with Store[Any](Path(scratch) if from_file else source, write=from_file) as store:
            if from_file:
                import_preferences(source, store)
            rng = streams(config.seed, 1)
            settings: Any = config
            reward = settings.reward.build(settings.task.build(), rng.build)
            fitted = fit(reward, store, config.fitting, rng.fit)
    save_reward(out, config, reward)
    return fitted


def with_reward(config: Config, saved: Path) -> Config:
    """Settings that improve a policy against a saved reward model, and ask nobody."""
    reward = open_saved(saved).config.reward
    return config.model_copy(update={"reward": reward, "loop": config.loop.model_copy(update={"labels": 0})})


def evaluate(folder: Path) -> Evaluation[Any]:
    """Evaluate the newest policy of a run, with its reward model."""
    saved = open_saved(folder)
    settings: Any = saved.config
    task = settings.task.build()
    learner = settings.learner.build(task, streams(saved.config.seed, 0).build)
    try:
        learner.load(load_state(saved.folder, "learner"))
    except ValueError as error:
        raise RunError(f"{folder} holds no policy to evaluate: {error}") from error
    evaluation: Evaluation[Any] = learner.evaluate(saved.reward(task), streams(saved.config.seed, 0).evaluate)
    return evaluation


def shrink(config: Config) -> Config:
    """The same components with as little work as possible: one round, a handful of labels."""
    parts = {name: value.shrunk() for name, value in config if isinstance(value, Settings)}
    return config.model_copy(update=parts)


def estimate(config: Config) -> float:
    """Seconds that a run would take, about, from one small round in a temporary folder."""
    small = shrink(config)
    with tempfile.TemporaryDirectory() as scratch, Store[Any](Path(scratch)) as store:
        loop = small.build(store)
        start, one = (round.metrics for round in loop.run())
    growth = {
        "sample": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        "label": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        # a fit sees all labels so far: half of them, on the average round
        "fit": config.loop.rounds * config.loop.labels / 2 / max(small.loop.labels, 1),
        "improve": config.loop.rounds * config.learner.work() / small.learner.work(),
    }
    evaluation = start["seconds/evaluate"] * (config.loop.rounds + 1)
    return evaluation + sum(one.get(f"seconds/{stage}", 0.0) * factor for stage, factor in growth.items())


def _keep_config(config: Config, folder: Path) -> None:
    """Write the settings beside a store that was made for the same task, or refuse."""
    if (folder / "config.yaml").exists() and saved_config(folder).task != config.task:
        raise RunError(f"{folder} holds labels for another task: choose another folder")
    write_file(folder / "config.yaml", config.dump().encode())
