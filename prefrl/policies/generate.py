"""Sampling from a causal language model: our own decode loop, for any of transformers', and fast for the usual ones.

Prompts are padded on the left and run once for each group of samples; tokens are drawn by inverting the CDF; rows that
have ended leave the batch. What comes back was drawn from the raw policy: no generation config has a say.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from typing import Any, Protocol, Self

import torch
from torch import Tensor
from transformers import DynamicCache, PreTrainedModel
from transformers.cache_utils import DynamicLayer

from prefrl.distributed import world
from prefrl.policies.decoder import FastDecoder, plan, right

ALONE: AbstractContextManager[None] = nullcontext()
"""What surrounds the passes of a model that this rank has whole: nothing."""
KEEP_SHARE = 0.75
"""Ended rows are dropped once this share or less of the rows goes on: moving the cache costs more than a few rows."""


@dataclass(frozen=True)
class Sampling:
    """How responses are drawn."""

    samples: int
    """K responses to each prompt."""
    max_tokens: int
    """L: the most tokens of a response, the end token included."""
    ends: tuple[int, ...]
    """The tokens that end a response; none for a fixed length."""
    temperature: float = 1.0
    """0 takes the most probable token."""
    top_k: int = 0
    """Draw among the most probable tokens alone; 0 for all. Not for learning: a policy's samples must be its own."""
    top_p: float = 1.0
    """Draw among the most probable tokens that hold this much of the probability (Holtzman et al. 2020)."""


@dataclass(frozen=True)
class Generation:
    """B = P x K responses, all of the first prompt first."""

    tokens: Tensor
    """(B, L) int64, right-padded with 0, the end token included where there is one."""
    mask: Tensor
    """(B, L) bool: the real tokens. Never worked out from the tokens: the padding may be a token like others."""
    logp: Tensor
    """(B, L) float32: log-probability of each token under the distribution it was drawn from; 0 on padding."""
    ended: Tensor
    """(B,) bool: whether an end token was drawn within L."""


class Decoder(Protocol):
    """One token more for each row of a batch."""

    def step(self, tokens: Tensor) -> Tensor:
        """(B,) the tokens just drawn -> (B, V) logits of the next ones."""

    def keep(self, rows: Tensor) -> None:
        """Go on with these rows only."""

    @property
    def joins(self) -> bool:
        """Whether it can take in others of its kind."""

    def join(self, other: Self) -> None:
        """Go on with the rows of another one as well, behind these."""


class CacheDecoder:
    """Any causal model, through transformers' own cache."""

    def __init__(self, model: PreTrainedModel, cache: DynamicCache, mask: Tensor, samples: int) -> None:
        cache.batch_repeat_interleave(samples)
        self._model, self._cache = model, cache
        self._mask = mask.repeat_interleave(samples, 0)
        self._positions = self._mask.sum(1, keepdim=True)  # (B, 1): where the first new token is, padding not counted

    def step(self, tokens: Tensor) -> Tensor:
        # For rows that have ended too: nobody reads what they go on to say.
        self._mask = torch.cat([self._mask, torch.ones_like(self._mask[:, :1])], 1)
        out = self._model(
            input_ids=tokens[:, None],
            attention_mask=self._mask,
            position_ids=self._positions,
            past_key_values=self._cache,
            use_cache=True,
        )
        self._positions = self._positions + 1
        logits: Tensor = out.logits[:, -1]  # (B, 1, V) -> (B, V)
        return logits

    def keep(self, rows: Tensor) -> None:
        self._cache.batch_select_indices(rows)
        self._mask, self._positions = self._mask[rows], self._positions[rows]

    @property
    def joins(self) -> bool:
        return all(type(layer) is DynamicLayer for layer in self._cache.layers)  # others keep a window, or a state

    def join(self, other: CacheDecoder) -> None:
        longest = int(torch.cat([self._mask.sum(1), other._mask.sum(1)]).max())
        layers: Any = zip(self._cache.layers, other._cache.layers, strict=True)  # of keys and values (B, G, T, D)
        for mine, others in layers:
            mine.keys = torch.cat([right(x.keys, longest, 2) for x in (mine, others)])
            mine.values = torch.cat([right(x.values, longest, 2) for x in (mine, others)])
        self._mask = torch.cat([right(x, longest, 1) for x in (self._mask, other._mask)])
        self._positions = torch.cat([self._positions, other._positions])


@torch.no_grad()
def generate(
    model: PreTrainedModel,
    prompts: Sequence[Sequence[int]],
    sampling: Sampling,
    generator: torch.Generator,
    fast: bool = True,
    at_once: int | None = None,
    running: AbstractContextManager[None] = ALONE,
) -> Generation:
    """Draw K responses to each of P prompts (token ids). Raises `ValueError` while the model is in training mode.

    `fast` allows the decoder that is written out, which agrees with the general one to rounding. `at_once`: the most
    rows in a batch, but for the K of one prompt; where rows end, those of the next prompts take their places.
    `running`: what surrounds the passes of this rank.
    """
    if model.training:
        raise ValueError("generation wants the model in eval mode: dropout would falsify its log-probabilities")
    count, shape = len(prompts), (len(prompts), sampling.samples, sampling.max_tokens)
    # All randomness is drawn first, a number for each place: what a row gets hangs neither on when others end, nor on
    # which rank it is on.
    uniform = torch.rand(shape, generator=generator)[world().mine].flatten(0, 1).to(model.device)
    mine = prompts[world().mine]
    with running:
        if mine or world().size == 1:
            drawn = _decode(_Opener(model, mine, sampling, fast), uniform, at_once)
        else:
            drawn = _nothing(uniform)
    if world().size == 1:
        return drawn
    found = [getattr(drawn, one.name).unflatten(0, (-1, sampling.samples)) for one in fields(Generation)]
    return Generation(*(world().whole(x, count).flatten(0, 1) for x in found))


def pad_left(prompts: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """(P, T) token ids and (P, T) mask; padding is 0, which is a valid id. Raises `ValueError` for an empty prompt."""
    if not prompts or not all(prompts):
        raise ValueError("generation wants at least one prompt, and at least one token in each (the begin token)")
    width = max(map(len, prompts))
    # On the left, so that the last column is the last token of every prompt.
    ids = torch.tensor([[0] * (width - len(p)) + list(p) for p in prompts])
    mask = torch.tensor([[0] * (width - len(p)) + [1] * len(p) for p in prompts])
    return ids, mask


@dataclass
class _Going:
    """Rows that are being written."""

    decoder: Decoder
    logits: Tensor
    """(b, V) of the next tokens."""
    rows: Tensor
    """(b,): which of the B responses they are."""
    at: Tensor
    """(b,): how many tokens each has."""


class _Opener:
    """Runs prompts, each once for its samples."""

    def __init__(
        self, model: PreTrainedModel, prompts: Sequence[Sequence[int]], sampling: Sampling, fast: bool
    ) -> None:
        self._model, self._prompts, self.sampling = model, prompts, sampling
        longest = max(map(len, prompts), default=0)
        self._plan = plan(model, longest + sampling.max_tokens) if fast else None
        self._next = 0

    @property
    def waiting(self) -> int:
        """Prompts that were not run yet."""
        return len(self._prompts) - self._next

    def open(self, count: int) -> _Going:
        """Run the next so many prompts."""
        first, self._next = self._next, self._next + count
        decoder, logits = self._prefill(self._prompts[first : first + count])
        rows = torch.arange(first * self.sampling.samples, self._next * self.sampling.samples, device=logits.device)
        return _Going(decoder, logits, rows, torch.zeros_like(rows))

    def _prefill(self, prompts: Sequence[Sequence[int]]) -> tuple[Decoder, Tensor]:
        """A decoder, and (b, V) logits of the first tokens."""
        model, samples = self._model, self.sampling.samples
        ids, mask = pad_left(prompts)
        ids, mask = ids.to(model.device), mask.to(model.device)
        cache = DynamicCache(config=model.config)
        # Padding is not counted: a model with absolute positions would otherwise see every prompt shifted.
        positions = (mask.cumsum(1) - 1).clamp(min=0)
        out = model(
            input_ids=ids,
            attention_mask=mask,
            position_ids=positions,
            past_key_values=cache,
            use_cache=True,
            logits_to_keep=1,
        )
        logits = out.logits[:, -1].repeat_interleave(samples, 0)  # (P, V) -> (b, V)
        if self._plan is not None:
            return FastDecoder(self._plan, cache, mask, samples, self.sampling.max_tokens), logits
        return CacheDecoder(model, cache, mask, samples), logits


def _nothing(uniform: Tensor) -> Generation:
    """Padding for (B, L) places."""
    logp = torch.zeros_like(uniform)
    return Generation(logp.long(), logp.bool(), logp, logp[:, 0].bool())


def _decode(opener: _Opener, uniform: Tensor, at_once: int | None) -> Generation:
    """With a number in [0, 1) for each of the (B, L) places."""
    found, samples = _nothing(uniform), opener.sampling.samples
    most = opener.waiting if at_once is None else max(1, at_once // samples)  # prompts
    going = opener.open(min(most, opener.waiting))
    while True:
        drawn, on = _draw_next(going, opener.sampling, uniform, found)
        left = int(on.sum())
        if not left and not opener.waiting:
            return found
        if not left:
            going = opener.open(min(most, opener.waiting))
            continue
        place = (most * samples - left) // samples  # for so many prompts
        refill = opener.waiting and place >= (1 - KEEP_SHARE) * most and going.decoder.joins
        more = opener.open(min(place, opener.waiting)) if refill else None
        # Rows that have ended go on meanwhile, but to no place that a model may not have.
        over = bool((going.at >= uniform.shape[1]).any())
        if left <= KEEP_SHARE * len(on) or more or over:
            kept = on.nonzero()[:, 0]
            going.decoder.keep(kept)
            going.rows, going.at, drawn = going.rows[kept], going.at[kept], drawn[kept]
        going.logits = going.decoder.step(drawn)
        if more:
            going = _joined(going, more)


def _draw_next(going: _Going, sampling: Sampling, uniform: Tensor, found: Generation) -> tuple[Tensor, Tensor]:
    """Write a token of each row down; (b,) the tokens, and (b,) bool: the rows that go on."""
    rows, at = going.rows, going.at.clamp(max=uniform.shape[1] - 1)
    drawn, drawn_logp = draw(_narrowed(going.logits, sampling), uniform[rows, at], sampling.temperature or 1.0)
    open_ = ~found.ended[rows] & (going.at < uniform.shape[1])  # others are still in the batch, and draw for nobody
    rows, at, said = rows[open_], at[open_], drawn[open_]
    found.tokens[rows, at], found.logp[rows, at], found.mask[rows, at] = said, drawn_logp[open_], True
    # Only after the mask was written: an end token is a real one.
    found.ended[rows] = torch.isin(said, torch.tensor(sampling.ends, dtype=torch.int64, device=said.device))
    going.at = going.at + 1
    return drawn, ~found.ended[going.rows] & (going.at < uniform.shape[1])


def _joined(one: _Going, other: _Going) -> _Going:
    one.decoder.join(other.decoder)
    return _Going(
        one.decoder,
        torch.cat([one.logits, other.logits]),
        torch.cat([one.rows, other.rows]),
        torch.cat([one.at, other.at]),
    )


def _narrowed(logits: Tensor, sampling: Sampling) -> Tensor:
    """(B, V) logits with minus infinity for what is not to be drawn."""
    if sampling.temperature == 0:
        return torch.full_like(logits, -torch.inf).scatter_(1, logits.argmax(1, keepdim=True), 0.0)
    if sampling.top_k:
        least = logits.topk(min(sampling.top_k, logits.shape[1])).values[:, -1:]
        logits = logits.masked_fill(logits < least, -torch.inf)
    if sampling.top_p < 1:
        ordered, order = (logits.float() / sampling.temperature).sort(1, descending=True)
        share = ordered.softmax(1)
        # What stands before a token must leave room for it: the most probable one always stays.
        gone = share.cumsum(1) - share >= sampling.top_p
        gone[:, 0] = False
        logits = logits.masked_fill(gone.scatter(1, order, gone), -torch.inf)
    return logits


def draw(logits: Tensor, uniform: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """(B, V) logits and (B,) numbers in [0, 1) -> (B,) tokens, by inverting the CDF; (B,) their log-probabilities."""
    # In float32: bfloat16 would lose two or three digits of every log-probability.
    share = tempered(logits, temperature).softmax(-1)
    cdf = share.cumsum(-1)
    total = cdf[:, -1:]
    # Rounding must not reach the total itself: the last token would be taken even where its probability is 0.
    target = torch.minimum(uniform[:, None] * total, torch.nextafter(total, torch.zeros_like(total)))
    tokens = torch.searchsorted(cdf, target, right=True)
    return tokens[:, 0], share.gather(1, tokens)[:, 0].log()  # what was drawn has a share above 0


def tempered(logits: Tensor, temperature: float) -> Tensor:
    """Logits in float32 at a temperature; a division by 1 would change nothing and read them all."""
    return logits.float() if temperature == 1 else logits.float() / temperature
