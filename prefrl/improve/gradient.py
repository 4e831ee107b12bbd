"""The one update that every policy gradient here makes: gradient steps on a batch that was sampled before.

Variant: PPO's surrogate (Schulman et al. 2017) or the plain policy gradient; a critic and an entropy bonus are terms
beside it, and a KL to a reference is part of the advantages, or a term as well where a policy knows it exactly. Each
term is averaged over the whole minibatch, however many parts it goes through the network in. It sees a policy and a
batch, and nothing of the world that they come from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeAlias, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from prefrl.distributed import world
from prefrl.fit.adam import Adam
from prefrl.improve import by_hand
from prefrl.improve.objectives import (
    Objective,
    clipped_surrogate,
    log_ratio,
    masked_sum,
    policy_gradient,
    reduce,
    value_loss,
)
from prefrl.protocols import Anchored, ByHand, Columns, I, Policy
from prefrl.seeding import to_numpy
from prefrl.types import Integers, Metrics, State

Parts: TypeAlias = Iterable[tuple[Tensor, dict[str, Tensor]]]
"""A loss in parts that add up, each with what it measured: (loss, name -> number)."""


@dataclass(frozen=True, eq=False)
class Batch(Generic[I]):
    """B sequences of at most L steps, and what a gradient step needs to know of each step."""

    inputs: I
    """What the policy reads; its mask (B, L) says which steps are real."""
    logp: Tensor
    """(B, L) log-probabilities under the policy that drew them."""
    advantages: Tensor
    """(B, L), or (B, 1) where all steps of a sequence have the same."""
    returns: Tensor | None = None
    """(B, L) the critic's targets."""
    values: Tensor | None = None
    """(B, L) what the critic expected when the batch was drawn."""

    def __len__(self) -> int:
        return len(self.logp)

    def rows(self, at: Tensor) -> Batch[I]:
        """Some sequences, cut to the longest of them."""
        inputs = self.inputs.rows(at)
        width = inputs.mask.shape[1]

        def cut(steps: Tensor | None) -> Tensor | None:
            return None if steps is None else steps[at, :width]

        advantages, logp = self.advantages[at, :width], self.logp[at, :width]  # (B, 1) stays (B, 1)
        return Batch(inputs, logp, advantages, cut(self.returns), cut(self.values))

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """In NumPy, of sequences of one step each: what the policy reads, and what the loss does."""
        own = {"logp": self.logp, "advantages": self.advantages, "returns": self.returns}
        return cast(Columns, self.inputs).columns() | {name: to_numpy(x) for name, x in own.items() if x is not None}

    def parts(self, size: int | None) -> Iterator[Batch[I]]:
        """This rank's sequences, at most `size` at a time, those together that are like each other; all at once for
        None."""
        if size is None and world().size == 1:
            yield self
            return
        mine = self.inputs.order()[world().mine]
        if len(mine):  # there may be fewer sequences than ranks
            for at in mine.tensor_split(parts_of(len(self), size)):
                yield self.rows(at)


@dataclass(frozen=True, eq=False)
class Beside(Generic[I]):
    """Behaviour whose log-probability is raised beside the objective, in each gradient step a part of it."""

    policy: Policy[I]
    """The one that learns, or a view of its weights."""
    batch: Batch[I]
    """Its advantages are how much each step counts."""
    weight: float
    """Of the mean log-probability."""
    minibatches: Iterator[Tensor]
    """Rows for as many gradient steps as there will be."""

    def part(self) -> Batch[I]:
        return self.batch.rows(next(self.minibatches))


class Optimizer(Protocol):
    """What takes gradient steps: `Adam`, or one of torch.optim's."""

    @property
    def param_groups(self) -> list[dict[str, Any]]: ...

    def zero_grad(self) -> None: ...

    def step(self) -> object: ...

    def state_dict(self) -> State: ...

    def load_state_dict(self, state: State, /) -> None: ...


def adam(parameters: Iterable[torch.nn.Parameter], learning_rate: float) -> Adam:
    """Adam with the eps of the PPO papers' code, which torch's default is a thousand times smaller than."""
    return Adam([{"params": list(parameters), "eps": 1e-5}], learning_rate)


def sgd(parameters: Iterable[torch.nn.Parameter], learning_rate: float) -> torch.optim.SGD:
    """Steps along the gradient itself, without momentum, as Mukherjee et al. (2026) take for policies of language."""
    return torch.optim.SGD(list(parameters), learning_rate)


OPTIMIZERS: dict[str, Callable[[Iterable[torch.nn.Parameter], float], Optimizer]] = {"adam": adam, "sgd": sgd}


def update(
    policy: Policy[I],
    optimizer: Optimizer,
    batch: Batch[I],
    minibatches: Iterable[Tensor],
    objective: Objective,
    part: int | None = None,
    beside: Beside[I] | None = None,
) -> list[Metrics]:
    """A gradient step on each minibatch, given as rows of the batch; what each step measured.

    `part`: at most so many sequences go through the network at once; that changes memory, and results by rounding only.
    `beside` adds its own loss to each step's, and is measured as shown_loss, before its weight.
    Raises FloatingPointError where a loss or a gradient is not finite.
    """
    if isinstance(policy, ByHand) and policy.works_by_hand and objective.value_clip is None:
        return _update_by_hand(policy, optimizer, batch, minibatches, objective, beside)
    return [step(policy, optimizer, batch.rows(rows), objective, part, beside) for rows in minibatches]


def _update_by_hand(
    policy: ByHand[I],
    optimizer: Optimizer,
    batch: Batch[I],
    minibatches: Iterable[Tensor],
    objective: Objective,
    beside: Beside[I] | None,
) -> list[Metrics]:
    parameters, longest = list(policy.parameters()), objective.max_grad_norm
    columns, found = batch.columns(), []
    for rows in map(to_numpy, minibatches):
        measured = by_hand.losses(policy, {k: x.take(rows, 0) for k, x in columns.items()}, objective)
        if beside is not None:
            assert isinstance(beside.policy, ByHand)
            measured |= by_hand.added(beside.policy, beside.part().columns(), beside.weight, measured["loss"])
        found.append(_moved(parameters, optimizer, measured, longest))
    return found


def step(
    policy: Policy[I],
    optimizer: Optimizer,
    batch: Batch[I],
    objective: Objective,
    part: int | None,
    beside: Beside[I] | None = None,
) -> Metrics:
    """One gradient step, by automatic differentiation.

    Metrics, means over steps unless said: loss, grad_norm (before it is shortened), policy_loss (averaged as the
    objective says), value_loss, kl_loss and entropy where there are any, clipped (the share of ratios beyond the clip),
    kl_old (from the policy that drew the batch, estimator k3) and ratio_error (the largest |pi / pi_old - 1|).
    """
    mask = batch.inputs.mask
    # Counts of the whole minibatch: a mean of the parts' means would give short parts too much weight.
    rows, steps = len(mask), int(mask.sum())
    parts: Parts = (_losses(policy, some, objective, rows, steps) for some in batch.parts(part))
    if beside is not None:
        parts = _with(beside, parts)
    return descend(policy.parameters(), optimizer, parts, objective.max_grad_norm)


def _with(beside: Beside[I], parts: Parts) -> Iterator[tuple[Tensor, dict[str, Tensor]]]:
    """The same parts, the first of which has the loss of what is learned beside as well."""
    shown = beside.part()
    count = len(shown)
    apart, _ = _losses(beside.policy, shown, Objective(), count, int(shown.inputs.mask.sum()))
    for number, (loss, seen) in enumerate(parts):
        mine = apart if number == 0 else loss.new_zeros(())
        yield loss + beside.weight * mine, seen | {"shown_loss": mine.detach()}


def descend(
    parameters: Iterable[torch.nn.Parameter],
    optimizer: Optimizer,
    parts: Parts,
    max_grad_norm: float,
) -> Metrics:
    """One gradient step on a loss that comes in parts, of all ranks together.

    Losses and measures add up over parts; `ratio_error` is the largest. Raises FloatingPointError, before anything
    changes, where the loss or the gradient is not finite.
    """
    optimizer.zero_grad()
    parameters, measured = list(parameters), []
    names: tuple[str, ...] = ()
    for loss, seen in parts:
        # One part's graph at a time is in memory; gradients add up in the parameters.
        loss.backward()  # type: ignore[no-untyped-call]
        names = ("loss", *seen)
        # Detached, or the list would keep every part's graph alive.
        measured.append(torch.stack([loss.detach(), *seen.values()]))
    world().sum_gradients(parameters)
    metrics = _added(names, torch.stack(measured).tolist() if measured else [])
    return _moved(parameters, optimizer, metrics, max_grad_norm)


def descend_by_logp(
    policy: Policy[I],
    optimizer: Optimizer,
    inputs: I,
    loss_of: Callable[[Tensor], tuple[Tensor, dict[str, Tensor]]],
    max_grad_norm: float,
) -> Metrics:
    """One gradient step on a loss of the log-probabilities (B, L) alone, by hand where the policy's gradient is.

    `loss_of` gives the loss and what it measured beside. Raises FloatingPointError as `descend` does.
    """
    if not (isinstance(policy, ByHand) and policy.works_by_hand):
        return descend(policy.parameters(), optimizer, [loss_of(policy.log_prob(inputs)[0])], max_grad_norm)
    logp, _, _, pull_back = policy.by_hand(cast(Columns, inputs).columns(), True, False)
    leaf = torch.from_numpy(logp).requires_grad_()
    loss, seen = loss_of(leaf)
    (slope,) = torch.autograd.grad(loss, leaf)
    pull_back(to_numpy(slope), 0.0, None)
    metrics = {name: float(x) for name, x in {"loss": loss.detach(), **seen}.items()}
    return _moved(policy.parameters(), optimizer, metrics, max_grad_norm)


def _moved(
    parameters: Iterable[torch.nn.Parameter], optimizer: Optimizer, metrics: Metrics, max_grad_norm: float
) -> Metrics:
    """Go down the gradient that the parameters have, and add how long it was to what was measured."""
    metrics["grad_norm"] = world().clip_gradients(parameters, max_grad_norm)
    for name in ("loss", "grad_norm"):
        if not math.isfinite(metrics[name]):
            raise FloatingPointError(
                f"the {name} of a gradient step is {metrics[name]}; expected a finite number: look at the reward "
                "model's scores, or lower learner.learning_rate"
            )
    optimizer.step()
    return metrics


def in_parts(at: Integers, size: int) -> Iterator[Integers]:
    """This rank's share of some rows, at most so many at a time."""
    mine = at[world().mine]
    if len(mine):
        yield from (some for some in np.array_split(mine, parts_of(len(at), size)) if len(some))


def parts_of(count: int, size: int | None) -> int:
    """In how many parts, of at most `size`, each rank takes its share of so many rows.

    As many on all ranks that have any: where weights are spread over ranks, each waits for the others in every part.
    """
    most = -(-count // world().size)
    return -(-most // (size or most))


def _added(names: tuple[str, ...], parts: list[list[float]]) -> Metrics:
    """The measures of a gradient step, from those of the parts on each rank; one without rows knows no names."""
    everywhere = world().gathered((names, parts))
    names = next(names for names, _ in everywhere if names)
    columns = zip(*(part for _, parts in everywhere for part in parts), strict=True)
    return {name: (max if name == "ratio_error" else sum)(column) for name, column in zip(names, columns, strict=True)}


def _losses(
    policy: Policy[I], batch: Batch[I], objective: Objective, rows: int, steps: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of a part of a minibatch that has so many rows and steps, and the terms that it is made of."""
    mask = batch.inputs.mask
    if not objective.policy:
        loss = _value(policy.values(batch.inputs), batch, objective) / steps
        return loss, {"value_loss": loss.detach()}
    if objective.kl:
        return _held_losses(policy, batch, objective, rows, steps)
    logp, entropies, values = _outputs(policy, batch.inputs, bool(objective.value))
    ratios = log_ratio(logp, batch.logp, mask)
    gain = _gain(logp, ratios, batch, objective)
    loss = policy_loss = reduce(gain, mask, objective.reduction, rows, steps)
    seen = {"policy_loss": policy_loss.detach()}
    if values is not None:
        value = _value(values, batch, objective) / steps
        loss, seen["value_loss"] = loss + objective.value * value, value.detach()
    if entropies is not None:
        entropy = masked_sum(entropies, mask) / steps
        loss, seen["entropy"] = loss - objective.entropy * entropy, entropy.detach()
    return loss, seen | _distances(ratios.detach(), objective, steps)


def _held_losses(
    policy: Policy[I], batch: Batch[I], objective: Objective, rows: int, steps: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """As `_losses`, with the KL to the starting policy as a term of its own: averaged as the policy's."""
    assert isinstance(policy, Anchored)
    mask = batch.inputs.mask
    logp, kls = policy.log_prob_and_kl(batch.inputs)
    ratios = log_ratio(logp, batch.logp, mask)
    policy_loss = reduce(_gain(logp, ratios, batch, objective), mask, objective.reduction, rows, steps)
    kl = reduce(kls, mask, objective.reduction, rows, steps)
    seen = {"policy_loss": policy_loss.detach(), "kl_loss": kl.detach()}
    return policy_loss + objective.kl * kl, seen | _distances(ratios.detach(), objective, steps)


def _gain(logp: Tensor, ratios: Tensor, batch: Batch[I], objective: Objective) -> Tensor:
    """(B, L): what each step adds to the policy's loss, before averaging."""
    if objective.clip is None:
        gain = policy_gradient(logp, batch.advantages)
    else:
        gain = clipped_surrogate(ratios, batch.advantages, objective.clip)
    return gain


def _outputs(policy: Policy[I], inputs: I, critic: bool) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Log-probabilities, entropies where they come cheap, and values where they are wanted."""
    return policy.log_prob_and_values(inputs) if critic else (*policy.log_prob(inputs), None)


def _value(values: Tensor, batch: Batch[I], objective: Objective) -> Tensor:
    """The critic's loss, summed over steps."""
    assert batch.returns is not None
    loss = value_loss(values, batch.returns)
    if objective.value_clip is not None:
        assert batch.values is not None
        near = batch.values + (values - batch.values).clamp(-objective.value_clip, objective.value_clip)
        loss = torch.maximum(loss, value_loss(near, batch.returns))  # the pessimistic one, as of the policy
    return masked_sum(loss, batch.inputs.mask)


def _distances(ratios: Tensor, objective: Objective, steps: int) -> dict[str, Tensor]:
    """How far the policy has gone from the one that drew the batch, from log-ratios that are 0 on padding."""
    ahead = ratios.expm1()  # r - 1, with the digits of ratios near 1
    apart = ahead.abs()
    return {
        "clipped": (apart > (objective.clip or math.inf)).sum() / steps,
        # The old policy drew the samples, so this is KL(old || new), by k3 with d = log old - log new.
        "kl_old": (ahead - ratios).sum() / steps,
        "ratio_error": apart.max(),
    }


def steer(optimizer: Optimizer, kl: float, target: float, start: float) -> None:
    """Move the learning rate by a factor of 1.5 towards a KL of `target`, as far as a hundredth of `start` or tenfold.

    Nothing changes while the KL is within a factor of two of the target.
    """
    group = optimizer.param_groups[0]
    factor = 1 / 1.5 if kl > 2 * target else 1.5 if kl < target / 2 else 1.0
    group["lr"] = min(max(group["lr"] * factor, 0.01 * start), 10 * start)
