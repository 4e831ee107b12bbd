"""What the learners of text share: a language model that is sampled, evaluated, counted and saved."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Literal, Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np

from prefrl.distributed import each_tensor, joined, world
from prefrl.evaluate.policies import responses
from prefrl.improve.gradient import OPTIMIZERS, Optimizer
from prefrl.policies.language import LanguagePolicy, LanguageSettings
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, TextTask
from prefrl.seeding import Device, device_of
from prefrl.types import Evaluation, Response, State, Steps

T = TypeVar("T")
Schedule: TypeAlias = Literal["constant", "linear"]


class WriterSettings(Protocol):
    """What the settings of a learner of text say of its policy."""

    @property
    def learning_rate(self) -> float: ...

    @property
    def schedule(self) -> Schedule: ...

    @property
    def device(self) -> Device: ...

    @property
    def policy(self) -> LanguageSettings: ...


@runtime_checkable
class WritesText(Protocol):
    """A learner whose policy may be a language model."""

    @property
    def policy(self) -> object: ...


class Writer:
    """A policy with its optimiser, and how many tokens it wrote for what."""

    def __init__(
        self,
        task: TextTask,
        settings: WriterSettings,
        rng: np.random.Generator,
        temperature: float = 1.0,
        critic: Literal["shared", "own", "reward"] | None = None,
        optimizer: Literal["adam", "sgd"] = "adam",
    ) -> None:
        """`temperature`: of sampling, and of every log-probability in the objective; `critic`: whose hidden states it
        reads, where there is one."""
        self._rate, self._schedule = settings.learning_rate, settings.schedule
        self.policy = LanguagePolicy(task, temperature, settings.policy, rng)
        if critic is not None:
            self.policy.add_critic(own=critic != "shared")
        self.steps = Steps()
        made = OPTIMIZERS[optimizer]
        self.optimizer: Optimizer = made(self.policy.parameters(), settings.learning_rate)
        self._gathered = self._gather() if self.policy.spread else {}
        """What rank 0 gathered last of a policy that is spread over ranks: it saves while the others are elsewhere."""
        self.policy.to(device_of(settings.device))
        # To be spread makes other parameters of them.
        self.optimizer = made(self.policy.parameters(), settings.learning_rate)

    def ask(self, count: int, each: int, rng: np.random.Generator) -> list[Response]:
        """At least `count` responses to be asked about, `each` to a random prompt, gold attached."""
        drawn = self.policy.respond(self.policy.task.prompts(-(-count // each), rng), each, rng)
        self.steps = self.steps.add(query=drawn.count)
        return self.policy.with_gold(drawn)

    def write(self, prompts: int, each: int, rng: np.random.Generator) -> Responses:
        """A batch to learn from: `each` responses to every one of so many random prompts."""
        drawn = self.policy.respond(self.policy.task.prompts(prompts, rng), each, rng)
        self.steps = self.steps.add(learn=drawn.count)
        return drawn

    def write_at_start(self, prompts: int, each: int, rng: np.random.Generator) -> Responses:
        """The same by the starting policy."""
        drawn = self.policy.respond_at_start(self.policy.task.prompts(prompts, rng), each, rng)
        self.steps = self.steps.add(learn=drawn.count)
        return drawn

    def paced(self, turns: Sequence[T]) -> Iterator[T]:
        """A round's turns, each with the learning rate that the schedule has for it."""
        for number, turn in enumerate(turns):
            if self._schedule == "linear":
                for group in self.optimizer.param_groups:
                    group["lr"] = self._rate * (1 - number / len(turns))
            yield turn

    def evaluate(self, prompts: int, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        """One response at temperature 1 to each evaluation prompt; see `prefrl.evaluate.policies.responses`."""
        evaluated, tokens = responses(self.policy, prompts, reward, rng)
        self.steps = self.steps.add(evaluate=tokens)
        return evaluated

    def state(self) -> State:
        if self.policy.spread and world().size == 1:
            return self._gathered
        found = self._gather()
        if self.policy.spread and world().rank == 0:
            self._gathered = found
        return found

    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ, or the starting policy is another one."""
        if state.get("start", self.policy.start_digest()) != self.policy.start_digest():  # older states do not say
            raise ValueError(
                "policy: it started from other weights than those that are there now: put back the model that the run "
                "began with, or begin a new run"
            )
        self.policy.load(state["model"])
        self.optimizer.load_state_dict(self._shares(state["optimizer"]))
        self.steps = Steps(*state["steps"])
        if self.policy.spread and joined().rank == 0:
            self._gathered = state

    def _gather(self) -> State:
        # The optimiser's tensors are live, and the next step changes them.
        optimizer = each_tensor(self.optimizer.state_dict(), self.policy.keeping.whole)
        held = {"optimizer": optimizer, "steps": list(self.steps), "start": self.policy.start_digest()}
        return {"model": self.policy.state(), **held}

    def _shares(self, state: State) -> State:
        """An optimiser's state of its own: of what is as large as its parameter, this rank's share."""
        state = copy.deepcopy(state)  # the optimiser may keep the very tensors that it is given
        parameters = self.policy.parameters()
        for number, held in state["state"].items():
            of = parameters[number]
            for name, value in held.items():
                if value.shape == of.shape:
                    held[name] = self.policy.keeping.share(value, of)
        return state
