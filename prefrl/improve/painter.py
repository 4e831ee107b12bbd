"""The part that learners of pictures share: a denoiser that is sampled, evaluated, counted and saved."""

from __future__ import annotations

import copy

import numpy as np

from prefrl.evaluate.pictures import drawn, evenly
from prefrl.improve.gradient import adam
from prefrl.policies.denoiser import Chains, DenoiserPolicy, DenoisingSettings
from prefrl.protocols import PictureTask, RewardModel
from prefrl.seeding import Device, device_of
from prefrl.types import Evaluation, Picture, State, Steps


class Painter:
    """A policy with its optimiser, and how many pictures it drew for what."""

    def __init__(self, task: PictureTask, settings: DenoisingSettings, learning_rate: float, device: Device) -> None:
        self.task, self.policy = task, DenoiserPolicy(task, settings)
        self.policy.to(device_of(device))
        self.optimizer = adam(self.policy.parameters(), learning_rate)
        self.steps = Steps()
        self._turns = list[str]()
        """Captions that are still to come before all come again."""

    def ask(self, count: int, rng: np.random.Generator) -> list[Picture]:
        """At least `count` pictures to be asked about, as many of each caption, gold attached."""
        captions = list(self.task.captions)
        chains = self.policy.draw(evenly(captions, -(-count // len(captions)) * len(captions)), rng)
        self.steps = self.steps.add(query=len(chains))
        return self.policy.with_gold(chains)

    def paint(self, groups: int, each: int, rng: np.random.Generator) -> Chains:
        """A batch to learn from: `each` pictures for every one of so many captions.

        All captions come in a random order before any comes again, however many batches that takes.
        """
        while len(self._turns) < groups:
            self._turns += [str(caption) for caption in rng.permutation(self.task.captions)]
        now, self._turns = self._turns[:groups], self._turns[groups:]
        chains = self.policy.draw([caption for caption in now for _ in range(each)], rng)
        self.steps = self.steps.add(learn=len(chains))
        return chains

    def evaluate(self, count: int, reward: RewardModel[Picture], rng: np.random.Generator) -> Evaluation[Picture]:
        """See `prefrl.evaluate.pictures.drawn`."""
        evaluated, pictures = drawn(self.policy, count, reward, rng)
        self.steps = self.steps.add(evaluate=pictures)
        return evaluated

    def state(self) -> State:
        # The optimiser's tensors are live, and the next step changes them.
        optimizer = copy.deepcopy(self.optimizer.state_dict())
        return {
            "model": self.policy.state(),
            "optimizer": optimizer,
            "steps": list(self.steps),
            "turns": list(self._turns),
            "start": self.policy.start_digest(),
        }

    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ, or the starting policy is another one."""
        if state["start"] != self.policy.start_digest():
            raise ValueError(
                "policy: it started from another denoiser than the one that is there now: put back the one that the "
                "run began with (it is kept in the cache folder), or begin a new run"
            )
        self.policy.load(state["model"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.steps = Steps(*state["steps"])
        self._turns = list(state.get("turns", []))  # older ones have none
