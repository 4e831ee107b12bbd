"""Learning from behaviours that nobody judged: pseudo-labels, and cropped segments.

Variant: SURF (Park et al. 2022, sections 4.1 and 4.2). The ensemble's mean labels a pair for all members, and sees the
segments as they were cropped; in the authors' code each member labels for itself, from uncropped ones. One length holds
for all windows of a gradient step, where theirs draws one for each pair. Left out: windows that reach beyond
a segment.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.fit.losses import choice
from prefrl.fit.settings import NO_CROP
from prefrl.types import C


def pairs(candidates: Sequence[C], first: int, count: int, order: torch.Generator) -> Tensor:
    """(count, 2) random pairs of candidates of one context, counted from `first`; fewer where there are none.

    A pair may come twice: it gets its pseudo-label anew each time.
    """
    by_context: dict[str, list[int]] = defaultdict(list)
    for at, candidate in enumerate(candidates):
        by_context[candidate.context].append(first + at)
    groups = [group for group in by_context.values() if len(group) > 1]
    if not groups or count <= 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    # A context by how many candidates it has, so that each candidate is as likely as any other.
    sizes = torch.tensor([len(group) for group in groups], dtype=torch.float64)
    picked = torch.multinomial(sizes, count, replacement=True, generator=order).tolist()
    drawn = [torch.randperm(len(groups[g]), generator=order)[:2].tolist() for g in picked]
    return torch.tensor([[groups[g][i], groups[g][j]] for g, (i, j) in zip(picked, drawn, strict=True)])


def pseudo_loss(scores: Tensor, edges: Tensor, confidence: float) -> Tensor:
    """The loss of pairs (U, 2) labelled by the ensemble itself (section 4.1), over scores (E, N).

    A pair is labelled, with the ensemble's favourite, where its mean probability is above `confidence`; the others
    count nothing, and the mean is over all of them, as in the paper.
    """
    found = scores[:, edges]  # (E, U, 2)
    probability = found.detach().softmax(-1).mean(0)  # a label is not to be bent towards the score
    best = probability.max(-1)
    target = torch.nn.functional.one_hot(best.indices, 2).to(scores.dtype)
    sure = (best.values > confidence).to(scores.dtype)
    return (choice(found, target) * sure).mean(1).sum()


def crop(stacked: Mapping[str, Tensor], share: float, order: torch.Generator) -> Mapping[str, Tensor]:
    """Cut windows of one random length, each at a random place, out of all segments (section 4.2).

    `share` is the most that is cut away; of a segment that is shorter than the window, nothing is. Raises
    `ConfigError` for a reward model that does not stack steps.
    """
    if "inputs" not in stacked:
        raise ConfigError(NO_CROP)
    count, steps = stacked["inputs"].shape[:2]
    shortest = max(1, round(steps * (1 - share)))
    length = int(torch.randint(shortest, steps + 1, (), generator=order))
    places = (stacked["mask"].sum(1) - length).clamp(min=0).long() + 1  # (N,): the last place is one of them
    begin = (torch.rand(count, generator=order).to(places.device) * places).long()[:, None]  # (N, 1)
    rows, columns = (torch.arange(n, device=places.device) for n in (count, length))
    # (N, T, ...) -> (N, length, ...), the mask too
    return {name: x[rows[:, None], begin + columns] for name, x in stacked.items()}
