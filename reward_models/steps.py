"""What every reward model for control shares: a network says something of each step, and a segment's score is the sum.

Variant: Christiano et al. 2017, section 2.2.3. Sums have no discount; each member is normalised over the steps of a
fit, and members are put together step by step. Left out: weights of single steps.

A network is small: it maps normalised steps to outputs, E members at once. All else is here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from prefrl.components import ConfigError, feature_functions, suggest
from prefrl.protocols import ControlTask
from prefrl.reward_models.ensemble import Ensemble, combine, combine_traced
from prefrl.seeding import to_numpy
from prefrl.types import Floats, Segment, State

CACHED = 4096
"""Steps of all members that go through a network at once, where it makes about a hundred numbers of each."""

Measure: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""(S, I) steps -> the mean (I,) and std (I,) that inputs are normalised by."""
Solve: TypeAlias = Callable[[Tensor, Tensor, Callable[[Tensor], Tensor]], None]
"""Fit a network without descent: normalised inputs (N, T, I), what a step counts in a score (N, T), the fit's loss."""

Describe: TypeAlias = Callable[[Floats, Floats], Floats]
"""(S, O) observations and (S, A) actions -> (S, d) hand-made features, a network's inputs in their place."""
NUMBERS = 4_194_304
"""In the inputs that go through a network at once."""


class Network(Protocol):
    """E members evaluated in one pass."""

    @property
    def members(self) -> int: ...

    @property
    def memory(self) -> int:
        """How many steps an output looks at, its own included."""

    @property
    def most(self) -> int:
        """How many steps go through at once, at most: what is made of them stays in cache."""

    def named(self) -> Mapping[str, Tensor]:
        """Everything that is saved. What is a parameter is fitted by descent."""

    def outputs(self, inputs: Tensor) -> Tensor:
        """(B, T, I) normalised steps, T <= memory (or any where memory is 1), or (E, B, T, I), each member's own.

        Returns (E, B, T). No step sees a later one.
        """

    @property
    def first(self) -> tuple[Tensor, Tensor] | None:
        """Weight (E, I, H) and bias (E, 1, H) of the one linear layer that the inputs meet, where there is one."""


OWN_FEATURES = ("inputs", "observations")
"""What a network can see of a step without another package."""


def observations_alone(observations: Floats, actions: Floats) -> Floats:
    """Features without the action: where a policy is, and not what it does there, as in T-REX (Brown et al. 2019)."""
    return observations


def described(features: str, own: Sequence[str] = OWN_FEATURES) -> Describe | None:
    """What the setting `reward.features` names; None for all of a step, as it is.

    Raises `ConfigError` for a name that is neither among a reward's own nor of an installed package.
    """
    if features == "observations":
        return observations_alone
    if features in own:
        return None
    installed = feature_functions()
    if features not in installed:
        hint = suggest(features, [*own, *installed])
        raise ConfigError(f"unknown reward.features {features!r}; {hint}; or install the package that brings them")
    function: Describe = installed[features].load()
    return function


def input_width(task: ControlTask, describe: Describe | None) -> int:
    """I: how many numbers a network sees of a step. Raises `ConfigError` for features that are not of steps."""
    if describe is None:
        return task.observation_size + task.action_size
    observation, action = (np.zeros((1, size), np.float32) for size in (task.observation_size, task.action_size))
    found = np.asarray(describe(observation, action))
    if found.ndim != 2 or len(found) != 1 or not found.size or found.dtype.kind not in "fiub":
        raise ConfigError(
            f"hand-made features: expected (S, d) real numbers for {observation.shape} observations and {action.shape} "
            f"actions, got {found.dtype} of shape {found.shape}"
        )
    return int(found.shape[1])


def uniform(shape: tuple[int, ...], fan_in: int, order: torch.Generator) -> torch.nn.Parameter:
    """torch.nn.Linear's default start: uniform within 1 / sqrt(fan in)."""
    return torch.nn.Parameter((torch.rand(shape, generator=order) * 2 - 1) / math.sqrt(fan_in))


class StepReward:
    """A `prefrl.protocols.StepRewardModel`: an ensemble of normalised members (Christiano et al. 2017, section 2.2.3).

    A segment's raw score is the sum of its steps' outputs times gain / segment_steps: a constant, so that scores add
    up over steps, while logits, and with them step sizes and error rates, do not depend on how long segments are. It
    sees observations and actions only: no time, no end of episode, no gold.
    """

    def __init__(
        self,
        network: Network,
        task: ControlTask,
        gain: float,
        ensemble: Ensemble,
        measure: Measure | None = None,
        solve: Solve | None = None,
        describe: Describe | None = None,
    ) -> None:
        self.network = network
        self._ensemble = ensemble
        self._measure = measure or each_input
        self._solve = solve
        self._describe = describe
        self._sizes = (task.observation_size, task.action_size)
        self._gain = gain / task.segment_steps
        width = input_width(task, describe)
        self._input_mean, self._input_std = torch.zeros(width), torch.ones(width)
        self._shift, self._scale = torch.zeros(network.members), torch.ones(network.members)
        self._temperature, self._fits = 1.0, 0

    @property
    def members(self) -> int:
        return self.network.members

    @property
    def memory(self) -> int:
        return self.network.memory

    @property
    def fitted(self) -> bool:
        return self._fits > 0

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return [p for p in self.network.named().values() if isinstance(p, torch.nn.Parameter)]

    def to(self, device: torch.device) -> None:
        for tensor in self._saved().values():
            tensor.data = tensor.data.to(device)

    def stack(self, candidates: Sequence[Segment]) -> Mapping[str, Tensor]:
        """Normalised inputs (N, T, I) and mask (N, T). Begins a fit: mean and std are measured here, and stay.

        Raises ValueError for a segment of other sizes than the task's.
        """
        steps = self._steps(candidates)
        lengths = torch.tensor([len(c) for c in candidates], device=steps.device)
        mask = torch.arange(max(map(len, candidates)), device=steps.device) < lengths[:, None]
        self._rebase(steps)  # first: it measures what is then normalised in place
        self._normalise_(steps)
        if mask.all():
            return {"inputs": steps.view(*mask.shape, -1), "mask": mask.float()}  # of one length: no copy
        inputs = steps.new_zeros(*mask.shape, steps.shape[1])
        inputs[mask] = steps
        return {"inputs": inputs, "mask": mask.float()}

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        inputs, mask = stacked["inputs"], stacked["mask"]
        if "used" in stacked and (self.memory == 1 or mask.shape[1] <= self.memory):
            return self._used_scores(inputs, mask, stacked["used"])
        if self.memory == 1:
            # Without memory, steps need no beginnings; padding goes through as well, and is masked below.
            outputs = self._outputs(inputs.flatten(0, 1), np.zeros(0)).view(self.members, *mask.shape)
        elif mask.shape[1] <= self.memory:
            outputs = self.network.outputs(inputs)
        else:
            outputs = mask.new_zeros(self.members, *mask.shape)
            outputs[:, mask.bool()] = self._outputs(*_flat(inputs, mask))  # (E, S) -> (E, N, T), row by row
        return (outputs * mask).sum(2) * self._gain

    def _used_scores(self, inputs: Tensor, mask: Tensor, used: Tensor) -> Tensor:
        """`scores` where each member passes over what it does not use (N, E): about a third, after a bootstrap."""
        count = max(1, int(used.sum(0).max()))  # the member that uses most decides, for all go through together
        first = used.T.long().argsort(stable=True, dim=1, descending=True)[:, :count]  # filled up with unused ones
        rows = max(1, self._most(inputs) // mask.shape[1])
        own = (  # (E, rows, T, I): each member's own candidates
            inputs.index_select(0, at.flatten()).view(*at.shape, *inputs.shape[1:])
            for at in torch.split(first, rows, 1)
        )
        outputs = torch.cat([self.network.outputs(each) for each in own], 1)
        sums = (outputs * mask[first]).sum(2) * self._gain
        return sums.new_zeros(used.T.shape).scatter(1, first, sums)  # (E, count) -> (E, N); 0 where passed over

    @torch.no_grad()
    def settle(self, stacked: Mapping[str, Tensor], loss: Callable[[Tensor], Tensor]) -> Tensor:
        inputs, mask = stacked["inputs"], stacked["mask"]
        if self._solve is not None:
            self._solve(inputs, mask * self._gain, loss)  # first: the outputs measured below are then the solution's
        real, begins = _flat(inputs, mask)
        outputs = self._outputs(real, begins)
        # Over steps, not candidates, for a policy is paid by the step. The clamp is for a reward that never varies.
        self._shift, self._scale = outputs.mean(1), outputs.std(1, correction=0).clamp(min=1e-6)
        self._temperature, self._fits = 1.0, self._fits + 1
        sums = _sums(to_numpy(outputs), np.flatnonzero(begins))
        return torch.from_numpy(sums).to(outputs.device) * self._gain

    def calibrate(self, temperature: float) -> None:
        self._temperature = temperature

    def raw_member_scores(self, candidates: Sequence[Segment]) -> Floats:
        sums = _sums(self._of(candidates, self._outputs), _starts(candidates))
        return sums * np.float32(self._gain / self._temperature)

    def member_scores(self, candidates: Sequence[Segment]) -> Floats:
        return _sums(self._of(candidates, self._member_rewards), _starts(candidates))

    def score(self, candidates: Sequence[Segment]) -> Floats:
        """(N,) sums of the steps' rewards: members are put together at each step, as in `rewards`."""
        rewards = self._of(candidates, self._member_rewards)
        return _sums(combine(rewards, self._ensemble, self._fits), _starts(candidates))

    @torch.no_grad()
    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        shape = observations.shape[:2]
        marks = np.zeros(shape, bool) if begins is None else np.array(begins, bool)  # a copy: it is written to below
        if observations.ndim != 3 or actions.shape[:2] != shape or marks.shape != shape:
            raise ValueError(
                f"rewards need observations (B, T, O), actions (B, T, A) and begins (B, T), got "
                f"{observations.shape}, {actions.shape} and {marks.shape}"
            )
        marks[:, :1] = True
        steps = self._normalise_(self._inputs(observations, actions))  # in place on the copy that _inputs makes
        found = to_numpy(self._member_rewards(steps, marks.ravel()))
        return combine(found, self._ensemble, self._fits).reshape(shape)

    @property
    def traceable(self) -> bool:
        return self._describe in (None, observations_alone)

    def traced(self, observations: Tensor, actions: Tensor) -> Tensor:
        steps = torch.cat([observations, actions], -1) if self._describe is None else observations
        begins = np.zeros(steps.shape[:2], bool)
        begins[:, 0] = True
        found = self._member_rewards(((steps - self._input_mean) / self._input_std).flatten(0, 1), begins.ravel())
        return combine_traced(found, self._ensemble, self._fits).view(steps.shape[:2])

    def features(self, candidates: Sequence[Segment]) -> Floats:
        """(N, 2 I): the mean and std of a segment's inputs over its steps, normalised as in the last fit.

        Before the first fit they are normalised by these candidates.
        """
        steps = self._steps(candidates)
        mean, std = (self._input_mean, self._input_std) if self.fitted else self._measure(steps)
        parts = torch.split((steps - mean) / std, [len(c) for c in candidates])
        return to_numpy(torch.stack([torch.cat([p.mean(0), p.std(0, correction=0)]) for p in parts]))

    def state(self) -> State:
        tensors = {name: x.detach().clone() for name, x in self._saved().items()}
        return {**tensors, "temperature": self._temperature, "fits": self._fits}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        saved = self._saved()
        for name, own in saved.items():
            found = tuple(state[name].shape) if name in state else "no shape, it is missing"
            if found != tuple(own.shape):
                raise ValueError(f"reward model: {name} has shape {found}, expected {tuple(own.shape)}: other settings")
        for name, own in saved.items():
            own.copy_(state[name])  # in place, after all were checked: a refused state leaves the model as it was
        self._temperature, self._fits = float(state["temperature"]), int(state["fits"])

    def _saved(self) -> dict[str, Tensor]:
        inputs = {"input_mean": self._input_mean, "input_std": self._input_std}
        return {**self.network.named(), **inputs, "shift": self._shift, "scale": self._scale}

    @torch.no_grad()
    def _of(self, candidates: Sequence[Segment], what: Callable[[Tensor, np.ndarray], Tensor]) -> Floats:
        """(E, S): `what` of the steps of all candidates, one after another."""
        steps = self._steps(candidates)  # (S, I)
        begins = np.zeros(sum(len(c) for c in candidates), bool)
        begins[_starts(candidates)] = True
        return to_numpy(what(self._normalise_(steps), begins))

    def _member_rewards(self, inputs: Tensor, begins: np.ndarray) -> Tensor:
        return (self._outputs(inputs, begins) - self._shift[:, None]) / self._scale[:, None]

    def _outputs(self, inputs: Tensor, begins: np.ndarray) -> Tensor:
        """(S, I) normalised steps of pieces that start where `begins` (S,) says -> (E, S): before shift and scale."""
        most = self._most(inputs)
        if self.memory > 1:
            return looking_back(self.network.outputs, inputs, begins, self.memory, most)
        return torch.cat([self.network.outputs(x[:, None])[:, :, 0] for x in torch.split(inputs, most)], 1)

    def _most(self, inputs: Tensor) -> int:
        """How many steps (..., I) go through at once."""
        return max(1, min(self.network.most, NUMBERS // inputs.shape[-1]))

    def _normalise_(self, steps: Tensor) -> Tensor:
        for piece in torch.split(steps, CACHED):  # two passes over what is still in cache
            piece.sub_(self._input_mean).div_(self._input_std)
        return steps

    @torch.no_grad()
    def _rebase(self, steps: Tensor) -> None:
        """Normalise by these inputs from now on; a fitted network's first layer makes up for it: it says the same.

        A fitted network whose inputs meet no such layer keeps the normaliser of its first fit.
        """
        first = self.network.first
        if self.fitted and first is None:
            return
        mean, std = self._measure(steps)
        if not mean.isfinite().all():  # what is not finite must only spoil its own candidate's score
            mean, std = self._measure(steps[steps.isfinite().all(1)])
        # W (x - m) / s + b is kept: with V = W / s, it is (V s') (x - m') / s' + b + V (m' - m).
        if self.fitted and first is not None:
            weight = first[0] / self._input_std[:, None]
            first[1].add_((mean - self._input_mean)[None, None] @ weight)
            first[0].copy_(weight * std[:, None])
        self._input_mean, self._input_std = mean, std

    def _steps(self, candidates: Sequence[Segment]) -> Tensor:
        """(S, I): the steps of all candidates, one after another, on the model's device."""
        if not len(candidates):
            raise ValueError("a reward model scores at least one segment at a time, got none")
        for one in candidates:
            self._check(one.observations, one.actions)
        # NumPy writes into torch's memory; "unsafe" lets float64 and integers be narrowed to float32.
        steps = torch.empty(sum(len(c) for c in candidates), sum(self._sizes))
        inside = to_numpy(steps)
        np.concatenate([c.observations for c in candidates], out=inside[:, : self._sizes[0]], casting="unsafe")
        np.concatenate([c.actions for c in candidates], out=inside[:, self._sizes[0] :], casting="unsafe")
        return self._described(steps)

    def _inputs(self, observations: Floats, actions: Floats) -> Tensor:
        """(B, T, O) and (B, T, A) -> (B T, I), on the model's device."""
        self._check(observations, actions)
        both = np.concatenate([observations, actions], -1, dtype=np.float32, casting="unsafe")
        return self._described(torch.from_numpy(both).flatten(0, 1))

    def _described(self, steps: Tensor) -> Tensor:
        """(S, O + A) -> (S, I): hand-made features in their place, where there are any."""
        device = self._input_mean.device
        if self._describe is None:
            return steps.to(device)
        observations, actions = np.split(to_numpy(steps), self._sizes[:1], 1)
        found = np.array(self._describe(observations, actions), np.float32)
        if found.shape != (wanted := (len(steps), len(self._input_mean))):
            raise ValueError(f"hand-made features of {len(steps)} steps must be of shape {wanted}, got {found.shape}")
        return torch.from_numpy(found).to(device)

    def _check(self, observations: Floats, actions: Floats) -> None:
        if (observations.shape[-1], actions.shape[-1]) != self._sizes or not observations.size:
            raise ValueError(
                f"this reward model needs observations (..., {self._sizes[0]}) and actions (..., {self._sizes[1]}), as "
                f"its task has them, of at least one step; got {observations.shape} and {actions.shape}"
            )
        for name, values in (("observations", observations), ("actions", actions)):
            if values.dtype.kind not in "fiub":
                raise ValueError(f"{name} must be real numbers, got dtype {values.dtype}")


def each_input(steps: Tensor) -> tuple[Tensor, Tensor]:
    """The mean and std of each input; a constant has std 1."""
    # Products are several times faster than mean and std over rows.
    each = torch.full((1, len(steps)), 1 / len(steps), device=steps.device)
    mean = (each @ steps)[0]
    squares = ((piece - mean).square_() for piece in torch.split(steps, CACHED))
    variance = sum((each[:, : len(piece)] @ piece)[0] for piece in squares)
    std = torch.as_tensor(variance).sqrt()
    return mean, torch.where(std > 1e-6, std, 1.0)


def _flat(inputs: Tensor, mask: Tensor) -> tuple[Tensor, np.ndarray]:
    """The real steps (S, I) of padded candidates, and where candidates begin (S,)."""
    real = mask.bool()
    begins = torch.zeros_like(real)
    begins[:, 0] = True  # each candidate is a piece of its own, whatever came before it in its episode
    if real.all():
        return inputs.flatten(0, 1), to_numpy(begins.flatten())
    return inputs[real], to_numpy(begins[real])


def _starts(candidates: Sequence[Segment]) -> np.ndarray:
    return np.cumsum([0, *(len(c) for c in candidates[:-1])])


def _sums(steps: Floats, starts: np.ndarray) -> Floats:
    """(..., S) values of the steps of N candidates that start there -> (..., N)."""
    sums: Floats = np.add.reduceat(steps, starts, -1)
    return sums


def looking_back(
    outputs: Callable[[Tensor], Tensor], inputs: Tensor, begins: np.ndarray, memory: int, most: int
) -> Tensor:
    """(E, S) outputs for steps (S, I) of episodes that start where `begins` (S,) says; the first step starts one.

    `outputs` maps (B, T, I), T <= memory, to (E, B, T) and lets no step see a later one. An episode's first `memory`
    steps are one row; each later step is the last of a row of its own. About `most` steps go through at once.
    """
    start, length, new = windows(begins, memory)
    found, places = list[Tensor](), list[np.ndarray]()
    rows = max(1, most // memory)
    for i in range(0, len(start), rows):
        part = slice(i, i + rows)
        at = np.arange(length[part].max())  # (L,): columns of this chunk of rows
        steps = np.minimum(start[part, None] + at, len(inputs) - 1)  # what lies beyond a row's end is not taken
        taken = (at < length[part, None]) & (at >= (length - new)[part, None])  # within its row, and new there
        shown, fresh = (torch.from_numpy(x).to(inputs.device) for x in (steps, taken))
        found.append(outputs(inputs[shown])[:, fresh])
        places.append(steps[taken])
    order = torch.from_numpy(np.concatenate(places).argsort()).to(inputs.device)  # back into the order of steps
    return torch.cat(found, 1)[:, order]


def windows(begins: np.ndarray, memory: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of at most `memory` steps that show each step once with all it may see.

    Returns where each row starts (W,), its length (W,), and of how many of its last steps the output is new (W,).
    """
    at = np.arange(len(begins))
    heads = np.flatnonzero(begins | (at == 0))
    ends = np.append(heads[1:], len(begins))
    age = at - np.repeat(heads, ends - heads)  # (S,): steps since the episode began
    late = np.flatnonzero(age >= memory)  # each of these needs a row of its own, of the steps up to it
    length = np.concatenate([np.minimum(ends - heads, memory), np.full(len(late), memory)])
    new = np.concatenate([length[: len(heads)], np.ones(len(late), np.int64)])
    return np.concatenate([heads, late - memory + 1]), length, new
