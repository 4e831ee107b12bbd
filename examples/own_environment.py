"""An environment of one's own, with answers by a teacher who sees its reward (about ten seconds).

    python examples/own_environment.py

With `labeler.kind=web` people answer in its place; that needs `get_state` and `set_state`: docs/own_environment.md.
"""

import gymnasium
import numpy as np

from prefrl import Config, Run


class Street(gymnasium.Env):
    """Stay in the middle of a street while a wind blows."""

    observation_space = gymnasium.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-2, 2, 1).astype(np.float32)
        return self.place, {}

    def step(self, action):
        self.place = np.clip(self.place + action + 0.3, -10, 10).astype(np.float32)
        return self.place, -abs(float(self.place[0])), False, False, {}


gymnasium.register("Street-v0", Street, max_episode_steps=50)

given = "task.env=Street-v0 task.horizon=50 task.segment_seconds=null task.segment_steps=10"
spent = "loop.rounds=3 loop.labels=60 learner.steps_per_round=4000"
config = Config.load("control/pendulum", [*given.split(), *spent.split(), "goal=Which one stays nearer to the middle?"])
with Run(config, "runs/street") as run:
    for round in run:
        print(f"round {round.number}: gold {round.metrics['evaluate/gold']:.1f}")
