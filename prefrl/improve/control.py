"""Our own policy gradients on the learned reward: PPO, A2C, REINFORCE with a learned baseline.

Variant: PPO's clip with GAE (Schulman et al. 2016, 2017), advantages whitened over the rollout, a learning rate steered
by the KL in place of early stopping, and extra epochs for the critic after each fit of the reward. Values are not
clipped. What actor and critic share is for the kind of policy to say (`learner.policy`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, cast

import numpy as np
import torch
from pydantic import BeforeValidator, Field, model_validator
from torch import Tensor

from prefrl.components import ConfigError, Settings, filled_in
from prefrl.distributed import each_tensor, world
from prefrl.improve.gradient import Batch, Beside, adam, steer, update
from prefrl.improve.objectives import Objective
from prefrl.improve.player import NO_ZIP, Player
from prefrl.improve.shown import Imitation, ImitationSettings
from prefrl.improve.valued import Turn, valued
from prefrl.policies.acting import Acting, Actor, ControlPolicy, Decide, Memory, allowed, forgotten
from prefrl.policies.cnn import CNNPolicySettings
from prefrl.policies.divided import environments, of_all
from prefrl.policies.flow import NEITHER, FlowPolicy, FlowPolicySettings
from prefrl.policies.gru import GRUPolicySettings
from prefrl.policies.maps import MapsPolicySettings
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.policies.origin import Owned, starting_state
from prefrl.policies.remembering import RememberingPolicy
from prefrl.policies.rollout import collect, joined, learned_rewards, step_rewards
from prefrl.policies.transformer import TransformerPolicySettings
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store, Task, simulated
from prefrl.seeding import Device, device_of, to_host
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps

ALGORITHMS: dict[str, dict[str, Any]] = {
    "ppo": {},
    "a2c": {"clip": None, "epochs": 1, "trace": 1.0, "rollout_steps": 16, "target_kl": None},
    "reinforce": {"clip": None, "epochs": 1, "trace": 1.0},
}
"""Defaults that differ from the fields below."""
ITS_OWN = {"hidden", "initial_std", "squash", "sde", "sde_steps"}
"""Settings of a policy that starts from another one, and that may be the other's."""
MOVED = ("hidden", "initial_std")
"""Settings that were the learner's own once, and are its policy's."""
SLOWER = 0.3
"""What is left of the learning rate when a round was undone."""


def _of_some_kind(given: Any) -> Any:
    return {"kind": "mlp"} | given if isinstance(given, dict) else given


PolicySettings: TypeAlias = Annotated[
    MLPPolicySettings
    | CNNPolicySettings
    | GRUPolicySettings
    | TransformerPolicySettings
    | FlowPolicySettings
    | MapsPolicySettings,
    Field(discriminator="kind"),
    BeforeValidator(_of_some_kind),
]


class ControlLearnerSettings(Settings):
    """Our own policy gradients on the learned reward: PPO by default, A2C or REINFORCE with a learned baseline."""

    kind: Literal["control"] = "control"
    algorithm: Literal["ppo", "a2c", "reinforce"] = "ppo"
    """What fills in the defaults: ppo (Schulman et al. 2017); a2c (Mnih et al. 2016), short rollouts and one step on
    each; reinforce (Williams 1992), whole returns. Anything that is set beside it stands."""
    environments: int = Field(16, ge=1)
    """How many are stepped side by side."""
    steps_per_round: int = Field(8192, ge=1)
    """Environment steps of one round's learning, all environments together; a multiple of `environments`."""
    rollout_steps: int = Field(128, ge=2)
    """Steps in each environment between updates, about: a round is divided into equal rollouts."""
    fresh_starts: bool = False
    """Begin each rollout with new episodes, as if time were up (partial-episode bootstrapping, Pardo et al. 2018): no
    more of an episode is learned from than `rollout_steps`, and less of what follows once a body has fallen."""
    epochs: int = Field(10, ge=1)
    """Passes over each rollout."""
    minibatch: int = Field(256, ge=2)
    """Steps in a gradient step."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's step size, or where it starts when it is steered."""
    discount: float = Field(0.99, ge=0, le=1)
    """What a reward a step later counts for."""
    trace: float = Field(0.95, ge=0, le=1)
    """GAE's lambda: 1 weighs whole returns, 0 only the next step."""
    target_kl: float | None = Field(0.01, gt=0)
    """Steer the learning rate until a rollout's updates move the policy by about this KL (nats); null keeps it."""
    clip: float | None = Field(0.2, gt=0)
    """How far the ratio of new to old probability counts; null for the plain policy gradient."""
    value_weight: float = Field(0.5, ge=0)
    """Weight of the critic's loss."""
    entropy: float = Field(0.01, ge=0)
    """Weight of the entropy bonus: it keeps a policy from settling on what an early, wrong reward praised."""
    critic_epochs: int = Field(10, ge=0)
    """Extra passes for the critic alone at the start of a round, when the reward is new to it."""
    max_grad_norm: float = Field(0.5, gt=0)
    """A gradient that is longer is shortened to this."""
    schedule: Literal["constant", "linear", "late"] = "late"
    """Over the run the learning rate stays as it is, falls to 0, or falls to 0 in the second half."""
    rollback: float | None = Field(0.1, ge=0)
    """What share of all that was gained, by the newest reward, a round may lose before the policy goes back to the best
    one; null keeps whatever comes."""
    policy: PolicySettings = MLPPolicySettings()
    """The network that acts, and its critic."""
    start: Path | None = None
    """A run of control, or a zip of stable-baselines3, whose policy this one starts from, with its critic, its noise
    and its normaliser, which stays what it was; from the working directory where it is relative. It needs the same
    widths and spaces."""
    clone: ImitationSettings = ImitationSettings()
    """What is taken from demonstrations: a clone to start as, and cloning beside the objective (DAPG)."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation, with the policy's mode, in environments of their own."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute: more make small networks slower; null leaves it to them."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        moved = [name for name in MOVED if isinstance(given, dict) and name in given]
        if moved:
            raise ValueError("\n".join(f".{name}: this is now learner.policy.{name}; write it there" for name in moved))
        found = filled_in(given, ALGORITHMS)
        return NEITHER | found if isinstance(found, dict) and _flows(found.get("policy")) else found

    @classmethod
    def renamed(cls, saved: dict[str, Any]) -> dict[str, Any]:
        kept = {name: value for name, value in saved.items() if name not in MOVED}
        moved = {name: value for name, value in saved.items() if name in MOVED}
        return kept | {"policy": {"kind": "mlp"} | moved} if moved else saved

    @model_validator(mode="after")
    def _whole_steps(self) -> ControlLearnerSettings:
        if self.steps_per_round % self.environments or self.steps_per_round < 2 * self.environments:
            raise ValueError(
                f"steps_per_round must be a multiple of environments, and at least twice it, "
                f"got {self.steps_per_round} and {self.environments}"
            )
        return self

    @model_validator(mode="after")
    def _plain_start(self) -> ControlLearnerSettings:
        plain = MLPPolicySettings().model_dump(exclude=ITS_OWN).items()
        owned = isinstance(self.policy, Owned)
        if self.start is not None and not owned and not plain <= self.policy.model_dump().items():
            raise ValueError(
                "start takes over a flow, a gru, a transformer, or a policy of kind mlp with tanh and one width for "
                f"actor and critic: leave learner.policy as it is, but for {', '.join(sorted(ITS_OWN))}"
            )
        return self

    @model_validator(mode="after")
    def _of_flows(self) -> ControlLearnerSettings:
        if isinstance(self.policy, FlowPolicySettings):
            self.policy.check(self.entropy, self.target_kl, min(self.rollout_lengths()))
        return self

    @model_validator(mode="after")
    def _cloneable(self) -> ControlLearnerSettings:
        if self.clone.on and (not isinstance(self.policy, MLPPolicySettings) or self.policy.sde):
            raise ValueError("clone needs a policy of kind mlp without sde: leave learner.policy as it is")
        return self

    def rollout_lengths(self) -> list[int]:
        """Steps in each environment of a round's rollouts."""
        each = self.steps_per_round // self.environments
        # Equal parts: a short last rollout would whiten its advantages over a handful of steps.
        parts = max(1, round(each / self.rollout_steps))
        return [len(part) for part in np.array_split(np.arange(each), parts)]

    def shrunk(self) -> ControlLearnerSettings:
        steps = min(self.steps_per_round, self.environments * self.rollout_steps)
        small = {"steps_per_round": steps, "evaluation_episodes": 1, "clone": self.clone.shrunk()}
        return self.model_copy(update=small)

    def with_evaluation_of(self, other: ControlLearnerSettings) -> ControlLearnerSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return float(self.steps_per_round)

    def build(self, task: Task, rng: np.random.Generator) -> ControlLearner:
        return ControlLearner(self, simulated(task, f"learner kind {self.kind!r} acts in control tasks"), rng)

    def objective(self) -> Objective:
        """What a gradient step minimises."""
        return Objective(
            clip=self.clip, value=self.value_weight, entropy=self.entropy, max_grad_norm=self.max_grad_norm
        )

    def formula(self) -> str:
        """The objective, as text."""
        flows = isinstance(self.policy, FlowPolicySettings)
        ratio = "exp(L_old(a|s) - L(a|s)) of flow-matching losses" if flows else "pi(a|s) / pi_old(a|s)"
        surrogate = (
            ("-L(a|s) A of the flow-matching loss" if flows else "log pi(a|s) A")
            if self.clip is None
            else f"min(r A, clip(r, {1 - self.clip:g}, {1 + self.clip:g}) A),  r = {ratio}"
        )
        bonus = "" if flows else f" + {self.entropy:g} H[pi]"
        lines = [
            f"maximise  mean[ {surrogate} ]{bonus} - {self.value_weight:g} mean[ (V(s) - R)^2 / 2 ]",
            f"A = GAE(discount {self.discount:g}, lambda {self.trace:g}) of the learned reward, whitened per rollout",
            "R = A + V before whitening; a time limit bootstraps from V(final observation), a termination does not",
            f"{self.epochs} epochs over each rollout; {self.critic_epochs} more for V alone after each reward fit",
        ]
        return "\n".join([*lines, *([self.clone.formula()] if self.clone.on else [])])


class ControlLearner:
    """A `prefrl.protocols.Learner` of segments.

    Rewards are scored once a rollout, in one batch, and multiplied by sqrt(1 - discount^2): returns, and with them the
    critic's targets, are then of the order of one for any discount. The normaliser moves between a rollout's last
    update and the next rollout only, so the probability ratio is exactly 1 before the first gradient step.
    """

    def __init__(self, settings: ControlLearnerSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        self._player = Player(task, settings.environments)
        self.policy: ControlPolicy[Any] = settings.policy.build(task, rng)
        self.policy.to(device_of(settings.device))
        self._optimizer = adam(self.policy.parameters(), settings.learning_rate)
        self._span = 0.0, 0.0
        self._imitation = Imitation(settings.clone, task, rng) if settings.clone.on else None
        # Read when it is first needed: a run that goes on has a policy of its own, and what it began with may be gone.
        self._start = settings.start

    @property
    def steps(self) -> Steps:
        return self._player.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round's rollouts; before the first round, of the starting policy (query steps)."""
        return self._player.sample(count, self._act(rng), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """`steps_per_round` environment steps of learning, from fresh episodes; metrics are means over rollouts.

        Those of `gradient.step`, each a mean over a rollout's gradient steps; explained, the share of the returns'
        variance that the critic explains; reward, the learned one of a step; and of a clone made now cloning_loss and
        demonstrations. Ranks share the environments, and learn from what came of all of them.
        """
        scorer, count = step_rewards(reward), self._settings.environments
        cloned, beside = self._imitate(store)
        envs, rollouts, metrics = environments(self._task, count), [], []
        observations, memory, begins = envs.reset(rng), None, None
        lengths = self._settings.rollout_lengths()
        for number, steps in enumerate(lengths):
            if number and self._settings.fresh_starts:
                observations, memory, begins = envs.reset(rng), None, None
            act = Acting(self._decide(), rng, memory)
            rollout, observations = collect(envs, observations, steps, act, begins)
            if self._settings.fresh_starts:
                rollout.truncated[:, -1] |= ~rollout.terminated[:, -1]
            read = partial(self.policy.read, rollout, memory)
            # Only before the first rollout is the reward one that the critic has not seen.
            left, new = self._left(number / len(lengths)), number == 0
            turn = Turn(rollout, read, left, new, bool(cloned), beside)
            metrics.append(self._once(partial(self._learn, turn, scorer, rng), rng))
            rollouts.append(rollout)
            begins = rollout.ends[:, -1]
            memory = forgotten(of_all(envs, act.memory), begins)
        # One rollout in time, so that an episode that spans two of them can be cut into segments all along.
        self._player.learned_from(joined(rollouts))
        return {name: float(np.mean([m[name] for m in metrics])) for name in metrics[0]} | cloned

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments."""
        return self._player.evaluate(self._settings.evaluation_episodes, self._act(None), reward, rng)

    def settle(self, reward: RewardModel[Segment]) -> Evaluation[Segment] | None:
        """Go back to the best policy, by the newest reward, where the last round lost clearly (`Best.settle`)."""
        if self._settings.rollback is None:
            return None
        weights = deepcopy(self._weights())
        undone, best = self._player.settle(weights, reward, self._settings.rollback), self._player.best.weights
        if undone is not None and best is not None:
            # From here the same steps might lead to the same loss; the next try, and each one after it, is slower.
            for group in best["optimizer"]["param_groups"]:
                group["lr"] *= SLOWER
            self.go_back()
        return undone

    def go_back(self) -> int | None:
        best = self._player.best
        if best.weights is None:
            return None
        self._take(deepcopy(best.weights))  # a copy: the optimiser goes on writing into what it is given
        return best.round

    def pace(self, begin: float, end: float) -> None:
        self._span = begin, end

    def actor(self) -> Actor:
        decide = self._decide()

        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            _, actions, memory = decide(observations, rng, allowed(self._task, observations), memory)
            return actions, memory

        return act

    def save(self, path: Path) -> None:
        """As a zip of stable-baselines3's PPO, which acts as this policy does. Raises ConfigError for kinds of policies
        that it has not."""
        if not isinstance(self.policy, MLPPolicy):
            raise ConfigError(NO_ZIP.format(self._settings.policy.kind))
        from prefrl.improve.to_sb3 import save_ppo  # stable-baselines3 takes a second to load

        self._begin()
        save_ppo(self.policy, self._task, path)

    def state(self) -> State:
        self._begin()
        cloned = {} if self._imitation is None else {"cloned": self._imitation.cloned}
        return self._weights() | self._player.state() | cloned

    def load(self, state: State) -> None:
        self._start = None
        if self._imitation is not None:
            self._imitation.cloned = state.get("cloned", True)  # a run of before there were clones has a policy
        self._take(state)
        self._player.load(state)

    def check_shown(self, shows: bool, judged: bool) -> None:
        if self._imitation is not None:
            self._imitation.check(shows)

    def check_ranks(self, count: int) -> None:
        if self._imitation is not None:
            raise ConfigError(
                f"learner.clone learns from demonstrations, which the first of {count} ranks alone has: leave it "
                "out, or start one rank"
            )
        if self._settings.environments < count:
            raise ConfigError(
                f"{count} ranks share the environments of a learner, and learner.environments is "
                f"{self._settings.environments}: raise it, or start fewer ranks"
            )

    def _weights(self) -> State:
        return {"policy": self.policy.state(), "optimizer": self._optimizer.state_dict()}

    def _take(self, weights: State) -> None:
        self.policy.load(weights["policy"])
        self._optimizer.load_state_dict(weights["optimizer"])

    def _once(self, learn: Callable[[], Metrics], rng: np.random.Generator) -> Metrics:
        """Learn on one rank, and have all know what it has learned.

        For a small network that takes less time than adding up the gradients of all ranks in every step, and it is the
        same to the bit on any number of them.
        """
        if world().size == 1:
            return learn()
        metrics, weights, drawn = world().first(
            lambda: (learn(), each_tensor(self._weights(), to_host), rng.bit_generator.state)
        )
        if world().rank:
            self._take(weights)
            rng.bit_generator.state = drawn
        return metrics

    def _begin(self) -> None:
        """Take over the policy that this one starts from, once."""
        if self._start is not None:
            assert isinstance(self._settings.policy, MLPPolicySettings | Owned)
            assert isinstance(self.policy, MLPPolicy | FlowPolicy | RememberingPolicy)
            self.policy.load(starting_state(self._start, self._task, self._settings.policy))
            # Few demonstrations show a part of the world: what lies elsewhere would change every scale at once.
            self.policy.freeze()
            self._start = None
        if self._imitation is not None:
            self._imitation.begin(cast(MLPPolicy, self.policy))

    def _imitate(self, store: Store[Segment]) -> tuple[Metrics, Callable[[np.random.Generator], Beside[Any] | None]]:
        """Become a clone where that is wanted, and say what is learned beside the objective in this round."""
        self._begin()
        if self._imitation is None:
            return {}, lambda _: None
        policy, shown = cast(MLPPolicy, self.policy), self._imitation.shown(store)
        cloned = self._imitation.first(policy, shown)
        return cloned, partial(self._imitation.beside, policy, shown, self._player.rounds)

    def _left(self, done: float) -> float:
        """What is left of the learning rate when that share of the round is done."""
        begin, end = self._span
        left = 1 - (begin + (end - begin) * done)  # more than 0: the end itself is never reached
        return {"constant": 1.0, "linear": left, "late": min(1.0, 2 * left)}[self._settings.schedule]

    @contextmanager
    def _slowed(self, left: float) -> Iterator[None]:
        (group,) = self._optimizer.param_groups
        steered = group["lr"]
        group["lr"] = steered * left
        yield
        group["lr"] = steered

    def _learn(self, turn: Turn, reward: StepRewardModel, rng: np.random.Generator) -> Metrics:
        """Learn from one rollout."""
        settings, left = self._settings, turn.left
        objective = replace(settings.objective(), policy=not turn.settled)
        rewards = learned_rewards(reward, turn.rollout)
        value = partial(valued, self.policy, turn.rollout, turn.read, rewards, settings.discount, settings.trace)
        batch, explained = value()
        if turn.new and settings.critic_epochs:
            self._update(batch, settings.critic_epochs, replace(objective, policy=False), left, rng)
            batch, explained = value()  # advantages by the critic that knows the new reward
        beside = turn.beside(rng) if objective.policy else None
        steps = self._update(batch, settings.epochs, objective, left, rng, beside)
        # Not before the update: actions were drawn under the old statistics, and the ratio must start at 1.
        self.policy.observe(turn.rollout.observations)
        if settings.target_kl is not None and objective.policy:
            last = steps[-len(steps) // settings.epochs :]  # the last epoch's
            kl = float(np.mean([step["kl_old"] for step in last]))
            # A KL goes with the square of the steps: a rate that is to fall is not steered up for it.
            steer(self._optimizer, kl / left**2, settings.target_kl, settings.learning_rate)
        means = {name: float(np.mean([step[name] for step in steps])) for name in steps[0]}
        if not self.policy.exact:
            del means["kl_old"]  # of ratios that are no probabilities' it would be none
        means["learning_rate"] = left * self._optimizer.param_groups[0]["lr"]
        if objective.policy:
            # The first step's, where nothing has changed yet: anything but rounding is a bug.
            means["ratio_error"] = steps[0]["ratio_error"]
        return means | {"explained": explained, "reward": float(rewards.mean())}

    def _update(
        self,
        batch: Batch[Any],
        epochs: int,
        objective: Objective,
        left: float,
        rng: np.random.Generator,
        beside: Beside[Any] | None = None,
    ) -> list[Metrics]:
        minibatches = self._minibatches(batch, epochs, rng)
        with self._slowed(left):
            return update(self.policy, self._optimizer, batch, minibatches, objective, beside=beside)

    def _minibatches(self, batch: Batch[Any], epochs: int, rng: np.random.Generator) -> list[Tensor]:
        """Rows of the batch, in each minibatch those of about as many steps as the settings say."""
        size = len(batch)
        parts = min(size, max(1, round(int(batch.inputs.mask.sum()) / self._settings.minibatch)))
        orders = [self._tensor(rng.permutation(size)) for _ in range(epochs)]
        # tensor_split leaves no small remainder, whose gradient would be mostly noise.
        return [rows for order in orders for rows in order.tensor_split(parts)]

    def _act(self, rng: np.random.Generator | None) -> Acting:
        """The policy's choices, drawn from `rng`, or its mode; in episodes that are yet to begin."""
        return Acting(self._decide(), rng)

    def _decide(self) -> Decide:
        self._begin()
        return self.policy.decide()

    def _tensor(self, array: np.ndarray) -> Tensor:
        """An array on the policy's device."""
        return torch.from_numpy(array).to(self.policy.device)


def _flows(policy: Any) -> bool:
    """Whether that much of the settings of a policy says that it is a flow."""
    return policy.get("kind") == "flow" if isinstance(policy, dict) else isinstance(policy, FlowPolicySettings)
