"""The roles: what a task, a labeler, a store, a reward model, a learner and a selector must be able to do.

Interfaces only; nothing inherits from them. Every component that fits one can be named in a config.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, TypeVar, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from prefrl.components import ConfigError
from prefrl.judgements import Answer, Demonstrated, Judged
from prefrl.kinds import PICTURES, RESPONSES, SEGMENTS
from prefrl.seeding import Device
from prefrl.types import (
    Bools,
    C,
    C_contra,
    Evaluation,
    Fields,
    Floats,
    Integers,
    Metrics,
    Picture,
    Query,
    Response,
    Segment,
    State,
    Steps,
)

if TYPE_CHECKING:
    import torch
    from transformers import PreTrainedModel, PreTrainedTokenizerBase


class Task(Protocol):
    """Where behaviours come from."""

    @property
    def name(self) -> str:
        """What people call it, "Pendulum-v1" say."""

    @property
    def kind(self) -> str:
        """The name of the kind of its candidates, see `prefrl.kinds`."""


@runtime_checkable
class Noted(Protocol):
    """A task of which people should know something."""

    @property
    def notes(self) -> Sequence[str]:
        """Whole sentences, such as how many prompts were left out."""


class DrawnTask(Task, Protocol[C_contra]):
    """A task whose candidates are shown as clips."""

    @property
    def fps(self) -> float:
        """Pictures of a clip per second."""

    def frames(self, candidate: C_contra, /) -> np.ndarray:
        """(T, H, W, 3) uint8 pictures of a candidate."""


@runtime_checkable
class Clocked(Protocol):
    """A task that stands for a world in which steps take time, as robots' do and board games' do not."""

    @property
    def steps_per_second(self) -> float: ...


class Transition(NamedTuple):
    """One step of n environments side by side."""

    observations: Floats
    """(n, O): what the next action is chosen from; already of the new episode where one has ended."""
    rewards: Floats
    """(n,): the gold. Nothing that learns may read it."""
    terminated: np.ndarray
    """(n,) bool: the episode reached a state without a future (value 0)."""
    truncated: np.ndarray
    """(n,) bool: the time was up; the future goes on unseen, so bootstrap."""
    final_observations: Floats
    """(n, O): what this step led to, before any reset."""


class TaskSettings(Protocol):
    """What chooses a task."""

    def build(self) -> Task: ...


class Dynamics(Protocol):
    """A world as a value: pure functions of states that are rows of an array, n of them side by side.

    `prefrl.envs.fast.vectorised.Vectorised` makes `Environments` of it.
    """

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        """(n, S) float64 first states."""

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        """States (n, S) and actions (n, A) -> new arrays: next states (n, S), rewards (n,), terminated (n,).

        Chance in a step is drawn from `rng`, for all n at once.
        """

    def observe(self, states: Floats) -> Floats:
        """(n, S) -> (n, O) float32."""

    def legal(self, states: Floats) -> Bools | None:
        """(n, A): which of the discrete actions there are in each state, at least one; None in every state where all
        always are."""

    def picture(self, state: Floats, size: int) -> np.ndarray | None:
        """(size, size, 3) uint8 of a state (S,), or None where there is nothing to see."""


@runtime_checkable
class Recognised(Dynamics, Protocol):
    """A world whose states can be told from what is seen."""

    def recognise(self, observations: Floats) -> Floats:
        """(n, O) -> (n, S) float64: states that look like these, whether or not an episode could come there."""


class Environments(Protocol):
    """n environments stepped together. An episode that ends is reset in the same step."""

    def reset(self, rng: np.random.Generator) -> Floats:
        """Start n new episodes; (n, O) float32."""

    def step(self, actions: Floats) -> Transition:
        """actions (n, A) float32: within the bounds for boxes, one-hot for discrete actions."""

    def states(self) -> Floats | None:
        """(n, S) float64 simulator states, enough to draw each environment as it stands, or None."""

    def legal(self) -> Bools | None:
        """(n, A): which discrete actions each environment allows now; None, always, where all are allowed."""


class ControlTask(Task, Protocol):
    """Episodes of a simulator."""

    @property
    def horizon(self) -> int:
        """Steps after which an episode is cut."""

    @property
    def segment_steps(self) -> int:
        """T of the segments that are judged."""

    @property
    def observation_size(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    @property
    def action_bounds(self) -> tuple[Floats, Floats] | None:
        """(low (A,), high (A,)), or None where actions are discrete (one-hot)."""

    @property
    def fps(self) -> float:
        """Control steps per second of simulated time."""

    def environments(self, count: int) -> Environments: ...

    def frames(self, segment: Segment) -> np.ndarray:
        """(T, H, W, 3) uint8 pictures of a segment, drawn from its states."""


@runtime_checkable
class Parted(Protocol):
    """A task of control whose environments several ranks can share."""

    def some_environments(self, count: int, which: range) -> Environments | None:
        """Those in `which` of `count` environments, to which the same happens as among all of them.

        They draw from the generator of `reset` what all of them would. None where that cannot be, or does not pay.
        """


class Outside(Protocol):
    """What an environment itself shows and takes, for a policy that acts in it without its task."""

    @property
    def changed(self) -> Sequence[str]:
        """In words, what is not as the policy has it: a row of numbers in, a row of numbers or a choice from 0 out."""

    @property
    def shown(self) -> str:
        """In words, what the policy sees of an observation; empty where it sees just that."""

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Of an observation as the environment gives it; None where it is no array."""

    def rows(self, observations: Any) -> tuple[Floats, bool]:
        """One observation, or n as a vectorised environment gives them -> (n, O) what the policy sees, and whether it
        was one. Raises ValueError for what is no observation of the environment."""

    def taken(self, actions: Floats) -> np.ndarray:
        """(n, A) what the policy does -> (n, ...) what the environment takes."""


@runtime_checkable
class OfEnvironment(Protocol):
    """A task of control whose environment may have spaces, and ends of episodes, of its own."""

    @property
    def outside(self) -> Outside | None:
        """None where they are the task's."""

    @property
    def variable_horizon(self) -> bool:
        """Whether it was told to let episodes end early."""


@runtime_checkable
class Mixed(Protocol):
    """A task of control that is several, of which each episode is of one."""

    @property
    def names(self) -> Sequence[str]: ...

    def which(self, observations: Floats) -> Integers:
        """(n, O) observations -> (n,) which of the tasks each is of."""


@runtime_checkable
class Recorded(Protocol):
    """A task of control whose simulator is not there: its behaviours are those of a file."""

    @property
    def segments(self) -> Sequence[Segment]:
        """All of them; the gold is attached where the file has it."""


@runtime_checkable
class Mapped(ControlTask, Protocol):
    """A task of discrete actions, of each of which something can be told before it is taken."""

    @property
    def maps(self) -> Sequence[str]:
        """The names of the F numbers that are told."""

    def told(self, observations: Floats) -> Floats:
        """(n, O) observations -> (n, A, F) float32, of the order of 1."""

    def legal(self, observations: Floats) -> Bools:
        """(n, O) -> (n, A): which actions there were."""


class Retold(NamedTuple):
    """What would be true of imagined steps."""

    observations: Floats
    """(n, O) float32: what is seen in these states, which may not be quite what was imagined."""
    states: Floats
    """(n, S) float64, of the simulator."""
    gold: Floats
    """(n,), of the actions in these states."""


@runtime_checkable
class Retells(ControlTask, Protocol):
    """A control task that may know what would be true of steps that were only imagined."""

    @property
    def retell(self) -> Callable[[Floats, Floats], Retold] | None:
        """Imagined observations (n, O) and actions (n, A) -> the simulator's states that look most like them, for
        people's eyes, and the gold, for oracles. None where what is seen does not tell the state."""


@runtime_checkable
class NamesActions(Protocol):
    """A task of control that has words for what can be done."""

    @property
    def action_names(self) -> Sequence[str]:
        """Of discrete actions, or of the dimensions of others; none where there are no words."""


class TextTask(Task, Protocol):
    """Prompts to be answered by a small language model."""

    @property
    def tokenizer(self) -> PreTrainedTokenizerBase: ...

    @property
    def response_tokens(self) -> int:
        """The most tokens that a response may have, the end token included."""

    @property
    def ends(self) -> tuple[int, ...]:
        """The tokens that end a response."""

    def model(self, frozen: bool = False) -> PreTrainedModel:
        """The starting policy, with dropout off: a copy of its own, or, `frozen`, on weights that all such models share
        and that nobody may change."""

    def encode(self, prompt: str) -> tuple[int, ...]:
        """The tokens of a prompt that the policy goes on from: with one begin token, or in its chat template."""

    def columns(self, prompt: str) -> Fields:
        """What else is known of a prompt, a correct answer say: for reward functions."""

    def prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        """Prompts to learn and to ask about."""

    def evaluation_prompts(self, count: int, rng: np.random.Generator) -> list[str]: ...

    def gold(self, responses: Sequence[Response]) -> Floats:
        """(N,) the hidden value of each response, or NaN where the task has none."""

    def fluency(self, responses: Sequence[Response]) -> Floats | None:
        """(N,) 1 where a response is well formed, else 0; None where the task cannot tell."""


@runtime_checkable
class Authored(TextTask, Protocol):
    """A task of text that can write texts of its own, by a grammar say."""

    def written(self, count: int, rng: np.random.Generator) -> list[Response]:
        """So many responses, each to a prompt of its own, of those to learn; without gold."""


class PictureTask(DrawnTask[Picture], Protocol):
    """Captions to be drawn for by a small denoiser."""

    @property
    def captions(self) -> Sequence[str]:
        """All that may be asked for."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W), or (H, W, 3)."""

    def denoiser(self) -> torch.nn.Module:
        """The starting policy, a copy of its own: a `prefrl.policies.denoiser.Denoiser`."""

    def gold(self, pictures: Sequence[Picture]) -> Floats:
        """(N,) the hidden value of each picture, or NaN where the task has none."""

    def spread(self, pictures: Sequence[Picture]) -> float:
        """How much pictures of one caption differ, as a share of how much real ones do; NaN for fewer than two."""


def control(task: Task, what: str) -> ControlTask:
    """A task, known to be of control. Raises `ConfigError` for others; `what` says who needs it and for what."""
    if task.kind != SEGMENTS.name:
        raise ConfigError(f"{what}, but the task is of kind {task.kind!r}")
    return cast(ControlTask, task)


def simulated(task: Task, what: str) -> ControlTask:
    """A task of control whose simulator is there, as `control` is for both."""
    found = control(task, what)
    if isinstance(task, Recorded):
        raise ConfigError(
            f"{what}, but {task.name} has no simulator: use learner.kind=cpl or iql, which learn from segments alone, "
            "or task.kind=control where the simulator is there"
        )
    return found


def text(task: Task, what: str) -> TextTask:
    """A task, known to be of text, as `control` is for its own."""
    if task.kind != RESPONSES.name:
        raise ConfigError(f"{what}, but the task is of kind {task.kind!r}")
    return cast(TextTask, task)


def pictures(task: Task, what: str) -> PictureTask:
    """A task of pictures, as `control` is for its own."""
    if task.kind != PICTURES.name:
        raise ConfigError(f"{what}, but the task is of kind {task.kind!r}")
    return cast(PictureTask, task)


@runtime_checkable
class PartlyGraded(Protocol):
    """A task that knows no gold of some of what it asks for, or of anything."""

    @property
    def ungraded(self) -> str:
        """What has none, in words; "" where everything has."""


def caption_numbers(task: PictureTask, captions: Iterable[str]) -> list[int]:
    """Which of the task's captions each is, counted from 0."""
    known = {caption: at for at, caption in enumerate(task.captions)}
    return [known[caption] for caption in captions]


class Labeler(Protocol[C]):
    """Who answers."""

    @property
    def name(self) -> str: ...

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """Answer open queries of the store: all of them now (an oracle), or as far as people have come."""


class Verdict(Protocol):
    """The answers to one pair of candidates, shown in both orders; NaN where there is none."""

    @property
    def forward(self) -> float:
        """The probability that the first is better, where it was shown first."""

    @property
    def backward(self) -> float:
        """The same, where it was shown second."""


@runtime_checkable
class Swapping(Protocol[C_contra]):
    """A labeler that shows each pair in both orders by itself, so that nobody has to ask it twice."""

    def compare(self, pairs: Sequence[tuple[C_contra, C_contra]], /) -> Sequence[Verdict]:
        """Judge pairs of candidates of one context."""


@runtime_checkable
class Demonstrates(Protocol):
    """A labeler that may answer with behaviours, and then is asked about one candidate at a time."""

    @property
    def demonstrates(self) -> bool: ...

    @property
    def corrects(self) -> bool:
        """Whether it answers about the learner's own; else it only shows or judges what it has."""


@runtime_checkable
class Advises(Protocol):
    """A labeler that can tell what it would do in any state of control: a policy is measured beside it."""

    def advice(self, observations: Floats) -> Floats:
        """Observations (n, O) -> actions (n, A), within the bounds, or one-hot."""

    @property
    def wavers(self) -> bool:
        """Whether what it does hangs on more than the state, and so is no measure: it goes one way or another in its
        own episodes, or it has a memory."""


@runtime_checkable
class GoesByGold(Protocol):
    """A labeler that may read the hidden gold."""

    @property
    def by_gold(self) -> bool:
        """Whether it does, and so cannot answer where there is none."""


@runtime_checkable
class Examined(Protocol):
    """A labeler that measures itself while it answers, as a judge that is asked in both orders."""

    @property
    def metrics(self) -> Metrics:
        """Of its newest answers, by name."""


@runtime_checkable
class AsksItself(Protocol):
    """Settings of a labeler that asks questions of its own and answers them, however many labels a run has."""

    @property
    def asks_itself(self) -> bool: ...


class LabelerSettings(Protocol):
    """What chooses a labeler."""

    def build(self, task: Any) -> Labeler: ...


@runtime_checkable
class Attended(Protocol):
    """A labeler for whom something must stand open while the store does: a page that people come to."""

    def open(self, store: Store, fixed: bool = False) -> list[str]:
        """Open it on a store that can be written to; returns what people should know, such as a link.

        `fixed`: no more will be asked than the store holds, and `answer` is to wait until all of it is answered.
        """

    def close(self) -> None:
        """Close it, before the store is closed. Does nothing where it is not open."""


class Judgements(Protocol[C]):
    """What was judged, to be read: by fits and report cards. A store is one, and so is a file."""

    @property
    def sequence(self) -> int:
        """The number of the newest event: the snapshot that a fit is made on."""

    def judged(self, upto: int | None = None) -> list[Judged[C]]:
        """Queries with their judgements, in the order in which they were given, up to a sequence number."""

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated[C]]:
        """Queries with the behaviours that answer them, as `judged`."""

    def open_queries(self, labeler: str = "") -> list[Query[C]]:
        """Queries without a judgement that this labeler has not skipped, oldest first. Candidates carry no gold."""

    def gold(self, candidates: Sequence[C]) -> list[Floats]:
        """The hidden values of candidates: for oracles and evaluation only."""


class Store(Judgements[C], Protocol[C]):
    """Every behaviour asked about and every answer given, append-only."""

    def ask(self, queries: Sequence[Query[C]]) -> None:
        """Add queries with their candidates; what is there already is left alone. Gold is filed apart."""

    def keep(self, candidates: Sequence[C]) -> None:
        """Add candidates that no query asks about: behaviours for demonstrations to show. Gold is filed apart."""

    def answer(self, answers: Sequence[Answer]) -> None:
        """Add answers, in one transaction; one per query and labeler: the first stands until it is retracted."""

    def retract(self, query: str, labeler: str) -> None:
        """Take a labeler's answer back; the log keeps both."""

    def counts(self) -> dict[str, int]:
        """Queries asked, answered, skipped; and demonstrations among the answers, where there are any."""

    def asked_before(self, ids: Sequence[str], sequence: int) -> set[str]:
        """Which of these queries and candidates had been asked about by then."""


class RewardModel(Protocol[C_contra]):
    """What is fitted. One network is an ensemble of E = 1; members are evaluated in one batched pass."""

    @property
    def members(self) -> int:
        """E."""

    @property
    def fitted(self) -> bool:
        """False until the first fit: its disagreement is then noise."""

    def stack(self, candidates: Sequence[C_contra]) -> Mapping[str, torch.Tensor]:
        """Candidates as padded tensors with N in front, made once per fit."""

    def scores(self, stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """(E, N) raw scores of stacked candidates, differentiable.

        A fit may add `used` (N, E) bool to what was stacked: where it is false, that member's score counts nothing, and
        need not be computed; any finite number does.
        """

    def parameters(self) -> Iterable[torch.nn.Parameter]: ...

    def to(self, device: torch.device) -> None:
        """Move everything to a device, once, before it is fitted or loaded: what is stacked lies there from then on."""

    def settle(self, stacked: Mapping[str, torch.Tensor], loss: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        """End a fit: freeze each member's shift and scale so that rewards have mean 0 and std 1 on these candidates.

        Returns their raw scores (E, N). `loss` maps such scores to the (E,) negative log-likelihoods of all training
        judgements, differentiably: for models that are solved for, or that want the curvature.
        """

    def calibrate(self, temperature: float) -> None:
        """Divide logits by this from now on, until the next fit ends (Guo et al. 2017)."""

    def raw_member_scores(self, candidates: Sequence[C_contra]) -> Floats:
        """(E, N) scores whose differences are calibrated logits: those of the fit over its temperature."""

    def member_scores(self, candidates: Sequence[C_contra]) -> Floats:
        """(E, N) scores after each member's shift and scale, without gradients."""

    def score(self, candidates: Sequence[C_contra]) -> Floats:
        """(N,) what learners optimise: `member_scores`, put together as the settings say (their mean, by default)."""

    def features(self, candidates: Sequence[C_contra]) -> Floats:
        """(N, d) what the candidates look like, for telling near ones from far ones; changes nothing."""

    def state(self) -> State: ...

    def load(self, state: State) -> None: ...


class RewardSettings(Protocol):
    """What chooses a reward model."""

    def build(self, task: Any, rng: np.random.Generator) -> RewardModel: ...


class StepRewards(Protocol):
    """Rewards of steps, whether they are fitted or not."""

    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        """(B, T) rewards of observations (B, T, O) and actions (B, T, A): shifted, scaled, put together.

        `begins` (B, T) bool marks the first step of each episode, for rewards that look back; without it each row is
        one episode, or a piece of one.
        """

    @property
    def memory(self) -> int:
        """How many steps a reward looks at: 1 where it hangs on its own step alone."""


@runtime_checkable
class StepRewardModel(RewardModel[Segment], StepRewards, Protocol):
    """A reward model for control: a segment's score is the sum of its steps' rewards."""


@runtime_checkable
class TracedRewards(Protocol):
    """Rewards of steps that say how they change with what was seen and done."""

    @property
    def traceable(self) -> bool:
        """Whether `traced` can be asked; not where features are made by hand, outside of torch."""

    def traced(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """As `StepRewards.rewards`, (B, T, O) and (B, T, A) -> (B, T), each row an episode or a piece of one, on the
        model's device: with gradients to both, whether the model's own weights take any or not."""


class Inputs(Protocol):
    """What a policy reads of B sequences of at most L steps: tokens of responses, or decisions and what was seen."""

    @property
    def mask(self) -> torch.Tensor:
        """(B, L) bool: the real steps."""

    def rows(self, at: torch.Tensor) -> Self:
        """Some sequences, cut to the longest of them."""

    def order(self) -> torch.Tensor:
        """(B,): in which order sequences go through a network in parts, so that those of a part are like each other."""


I = TypeVar("I", bound=Inputs)  # noqa: E741
I_contra = TypeVar("I_contra", bound=Inputs, contravariant=True)


class Policy(Protocol[I_contra]):
    """What a policy gradient improves: it can say how probable its choices were."""

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        """Everything that learns, the critic included."""

    def log_prob(self, inputs: I_contra) -> tuple[torch.Tensor, torch.Tensor | None]:
        """(B, L) log-probabilities of what was chosen, differentiable, and (B, L) entropies in nats where they come
        cheap; 0 on padding."""

    def values(self, inputs: I_contra) -> torch.Tensor:
        """(B, L) what the critic expects from each step on. Raises `ValueError` where there is no critic."""

    def log_prob_and_values(self, inputs: I_contra) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor]:
        """Both, in one pass where the critic shares the network."""


@runtime_checkable
class Anchored(Policy[I_contra], Protocol[I_contra]):
    """A policy that knows the exact KL of each step to the policy that it started from."""

    def log_prob_and_kl(self, inputs: I_contra) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, L) log-probabilities, and the KL of each step in nats given what came before it; differentiable."""


class PassByHand(NamedTuple):
    """A forward pass over B sequences of one step each, in NumPy, and the way back."""

    logp: Floats | None
    """(B, 1), as of `Policy.log_prob`."""
    entropies: Floats | None
    values: Floats | None
    """(B, 1)."""
    pull_back: Callable[[Floats | None, float, Floats | None], None]
    """Make a loss's gradient that of the parameters, from what it is of the log-probabilities (B, 1), of each entropy
    and of the values (B, 1)."""


class Columns(Protocol):
    """Sequences of one step each, all of them real."""

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """What the policy reads of them, (B, ...) each, in NumPy."""


@runtime_checkable
class ByHand(Policy[I_contra], Protocol[I_contra]):
    """A policy whose gradient is worked out by hand, where it works by hand at all. It reads `Columns`."""

    @property
    def works_by_hand(self) -> bool:
        """Whether it does so on the device where it is."""

    def by_hand(self, inputs: Mapping[str, npt.NDArray[Any]], actor: bool, critic: bool) -> PassByHand:
        """As `log_prob_and_values`, or one of the two alone, of some rows of the columns."""


@runtime_checkable
class LearnerSettings(Protocol):
    """What chooses a learner."""

    @property
    def device(self) -> Device:
        """Where its policy computes; the reward model goes there too."""

    @property
    def discount(self) -> float:
        """What a reward a step later counts for in learning; 1 where candidates are scored as a whole."""

    def build(self, task: Any, rng: np.random.Generator) -> Learner: ...


@runtime_checkable
class Threaded(Protocol):
    """Settings of a learner that say with how many threads a run computes."""

    @property
    def threads(self) -> int | None: ...


@runtime_checkable
class Settles(Protocol[C]):
    """A learner that goes back to its best policy where a round lost too much."""

    def settle(self, reward: RewardModel[C]) -> Evaluation[C] | None:
        """After an evaluation: None, or how the policy does that stands again."""

    def go_back(self) -> int | None:
        """Take up the best policy so far; returns the round that it is of, or None where no best one is kept."""


@runtime_checkable
class Acts(Protocol):
    """A learner whose policy acts in environments."""

    def actor(
        self,
    ) -> Callable[[Floats, np.random.Generator | None, Floats | None], tuple[Floats, Floats | None]]:
        """(n, O) observations, and (n, M) what is remembered, None at first -> (n, A) actions to execute, and what is
        remembered now: the policy's mode, or drawn where there is a generator."""

    def save(self, path: Path) -> None:
        """Write the policy as stable-baselines3 does."""


@runtime_checkable
class Divides(Protocol):
    """A learner of control whose work several ranks can share."""

    def check_ranks(self, count: int) -> None:
        """Raises `ConfigError` where so many cannot share it, before anybody is asked."""


@runtime_checkable
class Paced(Protocol):
    """A learner whose learning rate falls over the run."""

    def pace(self, begin: float, end: float) -> None:
        """Before a round: which shares of the run are over at its beginning and at its end."""


class Learner(Protocol[C]):
    """A policy that samples candidates, and gets better at good ones."""

    @property
    def steps(self) -> Steps:
        """What has been spent so far, by purpose."""

    def sample(self, count: int, rng: np.random.Generator) -> list[C]:
        """At least `count` candidates of the current policy, gold attached (the store files it apart)."""

    def improve(self, reward: RewardModel[C], store: Store[C], rng: np.random.Generator) -> Metrics:
        """One round's worth of learning: from the reward (reinforcement) or from the judgements (direct methods)."""

    def evaluate(self, reward: RewardModel[C], rng: np.random.Generator) -> Evaluation[C]:
        """Fresh episodes or responses; metrics `gold`, `learned` and what else the kind has (kl, fluency, length)."""

    def state(self) -> State: ...

    def load(self, state: State) -> None: ...


@runtime_checkable
class Imagines(Protocol[C]):
    """A learner that can foresee what its policy would do."""

    def imagine(self, count: int, rng: np.random.Generator) -> list[C]:
        """As many candidates as `Learner.sample` is asked for, of behaviour that never happened."""


@runtime_checkable
class Imitates(Protocol):
    """A learner that may learn from demonstrations alone."""

    def imitates(self, store: Store) -> bool:
        """Whether it can now, without a reward."""


@runtime_checkable
class NeedsShowing(Protocol):
    """A learner, or a labeler, that may need demonstrations."""

    def check_shown(self, shows: bool, judged: bool) -> None:
        """Raises `ConfigError`, before anybody is asked, where it needs them and there are none.

        `shows`: whether some are there, or for a learner will be; `judged`: the same of judgements.
        """


@runtime_checkable
class Particular(Protocol):
    """A learner that not every reward model will do for."""

    def check_reward(self, reward: RewardModel[Any]) -> None:
        """Raises `ConfigError` where it will not do, before anybody is asked."""


class Selector(Protocol[C]):
    """Which candidates are worth a label."""

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        """At most `count` queries over candidates of the pool."""


class SelectorSettings(Protocol):
    """What chooses a selector."""

    @property
    def candidates(self) -> int:
        """How many there are in a query."""

    def build(self) -> Selector: ...


__all__ = [
    "Attended",
    "ControlTask",
    "Divides",
    "Dynamics",
    "Environments",
    "Inputs",
    "Judgements",
    "Labeler",
    "LabelerSettings",
    "Learner",
    "Noted",
    "LearnerSettings",
    "Parted",
    "Particular",
    "PictureTask",
    "Policy",
    "Recorded",
    "RewardModel",
    "RewardSettings",
    "Selector",
    "SelectorSettings",
    "StepRewardModel",
    "StepRewards",
    "Store",
    "Swapping",
    "Task",
    "TaskSettings",
    "TextTask",
    "TracedRewards",
    "Transition",
    "Verdict",
]
