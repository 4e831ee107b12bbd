"""Answers from code of one's own: any program that can say which of two is better (a few seconds).

    python examples/own_labeler.py

This one likes points that move little. A labeler answers the store's open queries, all or some of them, when it can.
"""

from pathlib import Path
from typing import Literal

import numpy as np

from prefrl import Comparison, Config
from prefrl.components import Settings
from prefrl.store import Store


class CalmSettings(Settings):
    """Prefers the segment with the smaller actions; says "equal" where they hardly differ."""

    kind: Literal["calm"] = "calm"
    margin: float = 0.05

    def build(self, task):
        return Calm(self)


class Calm:
    name = "calm"

    def __init__(self, settings):
        self.settings = settings

    def answer(self, store, rng):
        answers = []
        for query in store.open_queries(self.name):
            first, second = (float(np.square(segment.actions).mean()) for segment in query.candidates)
            preference = 0.5 if abs(first - second) < self.settings.margin else float(first < second)
            answers.append(Comparison(query.id, preference, self.name))
        store.answer(answers)


config = Config.load("control/toy").model_copy(update={"labeler": CalmSettings()})
with Store(Path("calm-labels")) as store:
    loop = config.build(store)
    for round in loop.run():
        print(f"round {round.number}: {round.metrics.get('label/answered', 0):.0f} answers")
    moves = [np.square(segment.actions).mean() for segment in loop.learner.sample(50, np.random.default_rng(0))]
    print(f"mean square of an action: {np.mean(moves):.3f}")
