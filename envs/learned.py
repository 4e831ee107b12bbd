"""A world that is learned: an ensemble of dynamics over observations, fitted on real steps.

Variant: PETS's and MBPO's ensembles (Chua et al. 2018, section 4; Janner et al. 2019, section 4.1): each member
predicts the change of the observation from the observation and the action. What differs: members are deterministic and
are fitted by squared errors, each from its own start and on minibatches of its own, without bootstraps; an imagined
branch ends where members have parted too far, as MOReL's unknown states end one (Kidambi et al. 2020), instead of after
a length that is set by hand. What is left out: predicted variances, so chance in a world is averaged away.

It knows nothing of any task: it sees rows of numbers, and whether an episode terminated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.fit.adam import Adam
from prefrl.policies.perceptron import Activation, activated
from prefrl.policies.rollout import Rollout
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, Integers, Metrics, State

BLOCK = 20
"""Steps that are held out together, one after another; fewer of a short play."""
CHECKS = 20
"""How often in a fit the held-out loss is looked at."""
MARGIN = 0.1
"""How far beyond what was seen an imagined observation may lie, as a share of the range of each number."""
STILL = 1e-6
"""A number whose standard deviation is less does not change."""
PIECE = 16_384
"""Steps that go through the ensemble at once."""


class WorldSettings(Settings):
    """An ensemble of learned dynamics."""

    members: int = Field(5, ge=1)
    """E: how many networks. With one nothing can part, and only the held-out loss shortens branches."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Activation = "silu"
    """Between the layers."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's step size; it falls to a tenth over a fit."""
    fit_steps: int = Field(2000, ge=1)
    """Gradient steps of a fit, all members together. Each fit goes on from the weights of the one before."""
    minibatch: int = Field(256, ge=1)
    """Real steps in a gradient step, of each member its own."""
    held_out: float = Field(0.1, gt=0, lt=1)
    """The share of real steps that no fit sees: they say when to stop, and how far to trust the world."""
    longest: int = Field(100, ge=1)
    """The most steps of an imagined branch."""
    tolerance: float = Field(1.0, gt=0)
    """A branch ends when what its members disagree about adds up to this many standard deviations of an observation;
    and none is longer than this over the held-out error of a step."""

    def shrunk(self) -> WorldSettings:
        return self.model_copy(update={"fit_steps": min(self.fit_steps, 20)})


@dataclass(frozen=True, eq=False)
class Transitions:
    """N real steps."""

    observations: Floats
    """(N, O) float32."""
    actions: Floats
    """(N, A) float32, as they were executed."""
    following: Floats
    """(N, O) float32: what each led to, before any reset."""
    terminated: Bools
    """(N,)"""
    held_out: Bools
    """(N,): what no fit sees."""

    def __len__(self) -> int:
        return len(self.observations)

    @classmethod
    def of(
        cls, rollout: Rollout, share: float, rng: np.random.Generator, before: Transitions | None = None
    ) -> Transitions:
        """The steps of a rollout, a share of them held out for good, in blocks: a step whose neighbours were learned
        from is no test. The share is of the steps that move, as near as blocks come to it, with what the plays `before`
        held out too much or too little; the first play that can holds out a block, and none holds out all of them. Of
        what lies still, each action is kept once in each place: else the rest that follows an early end would be most
        of what is learned.

        Raises `ConfigError` where not all actions are always legal: a learned world does not know which are.
        """
        if rollout.legal is not None:
            raise ConfigError(
                "a learned world does not know which actions are legal, and in this task not all of them always are: "
                "use learner.kind=control"
            )
        rows = (rollout.observations, rollout.actions, rollout.final_observations)
        seen, done, following = (x.reshape(-1, x.shape[2]) for x in rows)
        still = np.flatnonzero((seen == following).all(1))
        _, first = np.unique(np.concatenate([seen, done], 1)[still], axis=0, return_index=True)
        kept = np.setdiff1d(np.arange(len(seen)), np.delete(still, first))
        moving = (seen != following).any(1)
        if not moving.any():
            moving[kept] = True
        earlier = np.zeros(0, bool) if before is None else before.held_out[before.moves]
        due = share * (len(earlier) + moving.sum()) - earlier.sum()
        held_out = _blocks(moving.reshape(rollout.ends.shape), share, due, 0 if earlier.any() else 1, rng)
        steps = seen[kept], done[kept].astype(np.float32), following[kept]
        return cls(*steps, rollout.terminated.ravel()[kept], held_out[kept])

    @property
    def moves(self) -> Bools:
        """(N,): whether a step changed what is seen."""
        found: Bools = (self.observations != self.following).any(1)
        return found

    @property
    def starts(self) -> Floats:
        """(M, O): where something moves on from; all, where nothing does."""
        return self.observations[self.moves] if self.moves.any() else self.observations

    def joined(self, other: Transitions) -> Transitions:
        return Transitions(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))

    def state(self) -> State:
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Imagined(NamedTuple):
    """What a member says that a step leads to."""

    observations: Floats
    """(n, O) float32."""
    terminated: Bools
    """(n,)"""
    parted: Floats
    """(n,): how far members lie apart, in standard deviations of an observation."""


class World:
    """E networks: (observation, action) -> the change of the observation, and whether the episode terminates."""

    def __init__(
        self, settings: WorldSettings, sizes: tuple[int, int], device: torch.device, rng: np.random.Generator
    ) -> None:
        """`sizes`: O and A."""
        self.settings, self._sizes = settings, sizes
        inputs, outputs, order = sum(sizes), sizes[0] + 1, generator(rng)
        pairs = list(pairwise((inputs, *settings.hidden, outputs)))
        shapes = [((settings.members, i, o), i) for i, o in pairs] + [((settings.members, 1, o), i) for i, o in pairs]
        # torch.nn.Linear's start: uniform within 1 / sqrt(fan in).
        drawn = [(torch.rand(shape, generator=order) * 2 - 1) / math.sqrt(fan_in) for shape, fan_in in shapes]
        self._layers = [torch.nn.Parameter(x.to(device)) for x in drawn]
        means, stds = {"input_mean": inputs, "change_mean": outputs}, {"input_std": inputs, "change_std": outputs}
        means, stds = means | {"low": sizes[0], "high": sizes[0]}, stds | {"spread": sizes[0]}
        self._scales = {name: torch.zeros(width, device=device) for name, width in means.items()}
        self._scales |= {name: torch.ones(width, device=device) for name, width in stds.items()}
        self.held_out, self.error = math.inf, math.inf
        """The held-out loss of the last fit, of which 1 is no better than the mean change; and the root mean square of
        the held-out error of a step, in standard deviations of an observation."""

    @property
    def members(self) -> int:
        return self.settings.members

    @property
    def device(self) -> torch.device:
        return self._layers[0].device

    @property
    def fitted(self) -> bool:
        return math.isfinite(self.held_out)

    @property
    def reach(self) -> int:
        """The most steps of a branch; 0 where the world is not to be dreamt in.

        Errors of steps add up at worst: after tolerance / error of them the limit is passed. A world that explains
        nothing of the held-out changes, or of what followed, is worth nothing, however small they are.
        """
        if not self.fitted:
            return 0
        explained = 1.0 - max(self.held_out, self.error**2)
        trusted = self.settings.tolerance * max(0.0, explained) / max(self.error, STILL)
        return int(min(self.settings.longest, trusted))

    def parameters(self) -> list[torch.nn.Parameter]:
        return [*self._layers]

    def predict(self, observations: Tensor, actions: Tensor) -> Tensor:
        """(n, O) and (n, A), or (E, n, ...), each member's own -> (E, n, O + 1): what follows, differentiable; the last
        number is above one half where the episode is thought to terminate."""
        after, ends = self._foreseen(observations, actions)
        # What was brought back has the gradient of what was not: else a policy would never learn to come back.
        return torch.cat([after + (self._within(after) - after).detach(), ends], -1)

    @torch.no_grad()
    def imagine(self, observations: Floats, actions: Floats, members: Integers) -> Imagined:
        """One step of n branches, each by one of the members (n,)."""
        device, rows = self.device, torch.from_numpy(members)
        parts = []
        for at in np.array_split(np.arange(len(members)), -(-len(members) // PIECE)):
            seen, done = (torch.from_numpy(x[at]).to(device) for x in (observations, actions))
            after, ends = self._foreseen(seen, done)
            # Before it is brought back to what was seen: beyond that members would seem to agree.
            parted = (after.var(0, correction=0) / self._scales["spread"] ** 2).mean(-1).sqrt()
            chosen = rows[at].to(device), torch.arange(len(at), device=device)
            found = self._within(after[chosen]), ends[chosen][:, 0] > 0.5, parted
            parts.append(Imagined(*map(to_numpy, found)))
        return Imagined(*(np.concatenate(some) for some in zip(*parts, strict=True)))

    def fit(self, data: Transitions, rng: np.random.Generator) -> Metrics:
        """Go on learning, from all real steps so far.

        Metrics: world_loss, world_held_out (mean squared errors of members, in variances of the changes: 1 is no better
        than their mean), world_error (root mean square, in standard deviations of an observation), world_steps (real
        steps learned from) and reach (steps). Where nothing is held out yet, nothing is learned, since nobody could say
        how far to trust it: the last two alone, 0 both.
        """
        if not data.held_out.any():
            return {"world_steps": 0.0, "reach": 0.0}
        self._rebase(data)
        settings = self.settings
        train, held = (self._normalised(data, at) for at in (~data.held_out, data.held_out))
        optimizer, best = Adam([{"params": self._layers}], settings.learning_rate), _Best(self._layers)
        every, losses = max(1, settings.fit_steps // CHECKS), []
        for number in range(settings.fit_steps):
            optimizer.param_groups[0]["lr"] = settings.learning_rate * (1 - 0.9 * number / settings.fit_steps)
            losses.append(self._step(train, optimizer, rng))
            if (number + 1) % every == 0 or number + 1 == settings.fit_steps:
                best.seen(self._layers, self._losses(*held))
        best.restore(self._layers)
        self.held_out, self.error = float(best.losses.mean()), self._error(*held)
        late = torch.stack(losses[-every:]).mean()
        found = {"world_loss": float(late), "world_held_out": self.held_out, "world_error": self.error}
        return found | {"world_steps": float((~data.held_out).sum()), "reach": float(self.reach)}

    def state(self) -> State:
        layers = [x.detach().clone() for x in self._layers]
        scales = {name: x.clone() for name, x in self._scales.items()}
        return {"layers": layers, "scales": scales, "held_out": self.held_out, "error": self.error}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""
        for own, saved in zip(self._layers, state["layers"], strict=True):
            if own.shape != saved.shape:
                raise ValueError(
                    f"world: a layer has shape {tuple(saved.shape)}, expected {tuple(own.shape)}: other settings or "
                    "task"
                )
            own.copy_(saved)
        for name, scale in self._scales.items():
            scale.copy_(state["scales"][name])
        self.held_out, self.error = float(state["held_out"]), float(state["error"])

    def _foreseen(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """(E, n, O) what follows, wherever it lies, and (E, n, 1) whether it ends the episode."""
        steps = torch.cat([observations, actions], -1)
        normalised = (steps - self._scales["input_mean"]) / self._scales["input_std"]
        change = self._outputs(normalised) * self._scales["change_std"] + self._scales["change_mean"]
        size = self._sizes[0]
        return observations + change[..., :size], change[..., size:]

    def _within(self, observations: Tensor) -> Tensor:
        """Near what was seen."""
        return observations.clamp(self._scales["low"], self._scales["high"])

    def _outputs(self, x: Tensor) -> Tensor:
        """(n, I) or (E, n, I), normalised -> (E, n, O + 1), normalised."""
        half = len(self._layers) // 2
        x = x.expand(self.members, -1, -1) if x.dim() == 2 else x
        for number, (weight, bias) in enumerate(zip(self._layers[:half], self._layers[half:], strict=True)):
            x = torch.baddbmm(bias, x, weight)
            x = activated(x, self.settings.activation) if number + 1 < half else x
        return x

    def _step(self, data: tuple[Tensor, Tensor], optimizer: Adam, rng: np.random.Generator) -> Tensor:
        """A gradient step; the mean loss before it."""
        inputs, targets = data
        drawn = rng.integers(len(inputs), size=(self.members, min(self.settings.minibatch, len(inputs))))
        at = torch.from_numpy(drawn).to(inputs.device)
        losses = (self._outputs(inputs[at]) - targets[at]).square().mean((1, 2))
        optimizer.zero_grad()
        losses.sum().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        return losses.detach().mean()

    @torch.no_grad()
    def _losses(self, inputs: Tensor, targets: Tensor) -> Tensor:
        """(E,)"""
        return (self._outputs(inputs) - targets).square().mean((1, 2))

    @torch.no_grad()
    def _error(self, inputs: Tensor, targets: Tensor) -> float:
        size = self._sizes[0]
        off = (self._outputs(inputs) - targets)[..., :size] * self._scales["change_std"][:size]
        return float((off / self._scales["spread"]).square().mean().sqrt())

    def _normalised(self, data: Transitions, at: Bools) -> tuple[Tensor, Tensor]:
        """Inputs (n, I) and targets (n, O + 1) of some steps."""
        inputs, changes = self._raw(data, at)
        inputs = (inputs - self._scales["input_mean"]) / self._scales["input_std"]
        return inputs, (changes - self._scales["change_mean"]) / self._scales["change_std"]

    def _raw(self, data: Transitions, at: Bools) -> tuple[Tensor, Tensor]:
        inputs = np.concatenate([data.observations[at], data.actions[at]], 1)
        changes = np.column_stack([data.following[at] - data.observations[at], data.terminated[at]])
        return torch.from_numpy(inputs).to(self.device), torch.from_numpy(changes.astype(np.float32)).to(self.device)

    @torch.no_grad()
    def _rebase(self, data: Transitions) -> None:
        """Normalise by these steps from now on; the first and last layers make up for it, so that the same is said."""
        own, half = self._scales, len(self._layers) // 2
        new = self._measured(data)
        if self.fitted:
            first, first_bias, last, last_bias = (self._layers[i] for i in (0, half, half - 1, -1))
            weight = first / own["input_std"][:, None]
            first_bias.add_((new["input_mean"] - own["input_mean"])[None, None] @ weight)
            first.copy_(weight * new["input_std"][:, None])
            ratio = own["change_std"] / new["change_std"]
            last.mul_(ratio)
            last_bias.mul_(ratio).add_((own["change_mean"] - new["change_mean"]) / new["change_std"])
        self._scales = new

    def _measured(self, data: Transitions) -> dict[str, Tensor]:
        inputs, changes = self._raw(data, ~data.held_out)
        after = torch.from_numpy(data.following[~data.held_out]).to(inputs.device)
        found = {"input_mean": inputs.mean(0), "change_mean": changes.mean(0)}
        found |= {"input_std": _std(inputs), "change_std": _std(changes), "spread": _std(after)}
        both = np.concatenate([data.observations, data.following])
        low, high = both.min(0), both.max(0)
        margin = MARGIN * (high - low)
        sides = {"low": low - margin, "high": high + margin}
        return found | {name: torch.from_numpy(x).to(inputs.device) for name, x in sides.items()}


def _blocks(moving: Bools, share: float, due: float, least: int, rng: np.random.Generator) -> Bools:
    """(n, T) which steps move -> (n T,): the steps of some blocks, drawn among those in which one does.

    As many as come nearest to `due` steps that move; but `least` at least where there are more, and never all.
    """
    rows, steps = moving.shape
    length = min(BLOCK, max(1, int(share * moving.sum())))  # a short play is not to be held out whole
    block = np.arange(rows)[:, None] * steps + np.arange(steps) // length
    blocks, sizes = np.unique(block[moving], return_counts=True)
    order = rng.permutation(len(blocks))
    nearest = int((sizes[order].cumsum() - sizes[order] / 2 <= due).sum())
    chosen = order[: min(max(nearest, least), len(blocks) - 1)]
    found: Bools = np.isin(block, blocks[chosen]).ravel()
    return found


def _std(rows: Tensor) -> Tensor:
    """Of each column; 1 where it does not change."""
    std = rows.std(0, correction=0)
    return torch.where(std > STILL, std, 1.0)


class _Best:
    """The weights of each member that did best on what is held out."""

    def __init__(self, layers: list[torch.nn.Parameter]) -> None:
        self._layers = [x.detach().clone() for x in layers]
        self.losses = torch.full((len(layers[0]),), math.inf, device=layers[0].device)

    def seen(self, layers: list[torch.nn.Parameter], losses: Tensor) -> None:
        better = losses < self.losses
        self.losses = torch.where(better, losses, self.losses)
        for kept, new in zip(self._layers, layers, strict=True):
            kept[better] = new.detach()[better]

    @torch.no_grad()
    def restore(self, layers: list[torch.nn.Parameter]) -> None:
        for own, kept in zip(layers, self._layers, strict=True):
            own.copy_(kept)


__all__ = ["Imagined", "Transitions", "World", "WorldSettings"]
