"""A run tried at a small size: how long will the whole take?"""

from __future__ import annotations

import tempfile
from pathlib import Path

from prefrl.components import Settings
from prefrl.config import Config
from prefrl.evaluate.summary import judged, pace
from prefrl.protocols import Noted
from prefrl.report.costs import Spent
from prefrl.stages.labels import Tell
from prefrl.store import Store


def shrink(config: Config) -> Config:
    """The same components with as little work as possible: one round, a handful of labels."""
    parts = {name: value.shrunk() for name, value in config if isinstance(value, Settings)}
    return config.model_copy(update=parts)


def estimate(config: Config, tell: Tell = lambda _: None) -> Spent:
    """What a run would take, about, from one small round of the true task in a temporary folder.

    `tell` is given what the task has to say of itself. Evaluation is done at its true size. A starting policy that has
    to be made first is made, and kept.
    """
    small = shrink(config)
    learner = small.learner.with_evaluation_of(config.learner)
    small = small.model_copy(update={"task": config.task, "learner": learner})
    with tempfile.TemporaryDirectory() as scratch, Store(Path(scratch)) as store:
        loop = small.build(store)
        loop.check_shown()
        for note in config.notes():
            tell(note)
        for note in loop.task.notes if isinstance(loop.task, Noted) else ():
            tell(note)
        start, one = (round.metrics for round in loop.run())
    growth = {
        "sample": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        "label": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        # a fit sees all labels so far: half of them, on the average round
        "fit": config.loop.rounds * config.loop.labels / 2 / max(small.loop.labels, 1),
        "improve": config.loop.rounds * config.learner.work() / small.learner.work(),
    }
    evaluations = config.loop.rounds + 1
    seconds = sum(one.get(f"seconds/{stage}", 0.0) * factor for stage, factor in growth.items())
    learned = config.loop.rounds * config.learner.real_work() / small.learner.real_work()
    steps = {"learn": learned, "query": growth["sample"], "evaluate": evaluations / 2}  # of the two in `one`
    spent = sum(one.get(f"steps/{purpose}", 0.0) * factor for purpose, factor in steps.items())
    people = 0.0 if judged(one) else None
    return Spent(
        round(spent), pace(loop.task), config.loop.labels, people, seconds + start["seconds/evaluate"] * evaluations
    )
