"""A language model as a policy, and responses as tensors: sampled once, scored by forward passes, never decoded and
encoded again in between."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from prefrl.components import ConfigError
from prefrl.policies.generate import Sampling, generate
from prefrl.protocols import TextTask
from prefrl.seeding import generator
from prefrl.types import Response, State


@dataclass(frozen=True, eq=False)
class Responses:
    """B responses, K to each prompt, all of the first prompt first."""

    prompts: tuple[str, ...]
    """Each row's own."""
    prompt_tokens: tuple[tuple[int, ...], ...]
    tokens: Tensor
    """(B, L) int64, right-padded."""
    mask: Tensor
    """(B, L) bool: the real tokens, the end token included."""
    logp: Tensor
    """(B, L) float32: log-probabilities at sampling; 0 on padding, and where nobody sampled them here."""
    ended: Tensor
    """(B,) bool: whether there is an end token."""

    def __len__(self) -> int:
        return len(self.prompts)

    @property
    def count(self) -> int:
        """How many tokens were generated."""
        return int(self.mask.sum())

    def rows(self, at: Tensor) -> Responses:
        """Some rows, cut to the longest of them."""
        width = int(self.mask[at].sum(1).max())
        tokens, mask, logp = (x[at, :width] for x in (self.tokens, self.mask, self.logp))
        chosen = at.tolist()
        prompts, prompt_tokens = tuple(self.prompts[i] for i in chosen), tuple(self.prompt_tokens[i] for i in chosen)
        return Responses(prompts, prompt_tokens, tokens, mask, logp, self.ended[at])

    def lengths(self) -> Tensor:
        """(B,) tokens of prompt and response together."""
        return self.mask.sum(1) + self.mask.new_tensor([len(p) for p in self.prompt_tokens], dtype=torch.int64)

    def parts(self, size: int) -> Iterator[tuple[Tensor, Responses]]:
        """Rows of like length together: (their indices, the rows), so that little padding is computed on."""
        for at in self.lengths().argsort(stable=True).split(size):  # type: ignore[no-untyped-call]
            yield at, self.rows(at)

    @classmethod
    def of(
        cls, candidates: Sequence[Response], tokenizer: PreTrainedTokenizerBase, device: torch.device | None = None
    ) -> Responses:
        """Responses that were sampled as they were; those that came as text alone are encoded, an end token added."""
        ends, pairs = int(tokenizer.eos_token_id), []
        for one in candidates:
            # Text that is encoded anew can merge across the border, into tokens that nobody sampled.
            prompt = one.prompt_tokens or tuple(tokenizer.encode(one.prompt))
            tokens = one.tokens or (*tokenizer.encode(one.text, add_special_tokens=False), ends)
            pairs.append((prompt, tokens))
        padded, lengths = pad_right([tokens for _, tokens in pairs], device)
        mask = torch.arange(padded.shape[1], device=device) < lengths[:, None]
        ended = torch.tensor([tokens[-1] == ends for _, tokens in pairs], device=device)
        # a mask is filled row by row
        texts, unknown = tuple(one.prompt for one in candidates), torch.zeros(mask.shape, device=device)
        return cls(texts, tuple(prompt for prompt, _ in pairs), padded, mask, unknown, ended)

    def candidates(self, tokenizer: PreTrainedTokenizerBase) -> list[Response]:
        """The same as the vocabulary's `Response`s, without gold."""
        found = []
        for i, prompt in enumerate(self.prompts):
            tokens = self.tokens[i, self.mask[i]].tolist()
            text = str(tokenizer.decode(tokens, skip_special_tokens=True))
            found.append(Response(prompt, text, self.prompt_tokens[i], tuple(tokens)))
        return found


class LanguagePolicy:
    """A `prefrl.protocols.Policy` of `Responses`: a causal language model beside the one that it started from.

    Both stay in evaluation mode throughout, so the probability ratio is 1 (to rounding) before a batch's first step.
    `temperature` is that of sampling and of every log-probability, unless another is asked for; at most `part` rows go
    through a network at once. Raises `ConfigError` for models whose logits are more than their head says.
    """

    def __init__(self, task: TextTask, temperature: float, part: int) -> None:
        self.task, self.temperature, self.part = task, temperature, part
        self.model, self.start = task.model(), task.model().requires_grad_(False)  # two copies of the weights
        check_head(self.model)

    @property
    def device(self) -> torch.device:
        return self.model.device

    def to(self, device: torch.device) -> None:
        """Move both models to a device."""
        for model in (self.model, self.start):
            model.to(device)  # type: ignore[arg-type]  # transformers wraps torch's method

    def parameters(self) -> list[torch.nn.Parameter]:
        return list(self.model.parameters())

    def log_prob(self, inputs: Responses) -> tuple[Tensor, None]:
        return response_logp(self.model, inputs, self.temperature), None

    def values(self, inputs: Responses) -> Tensor:
        raise ValueError("a language model without a critic has no values: set the weight of the critic's loss to 0")

    def respond(
        self, prompts: Sequence[str], samples: int, rng: np.random.Generator, temperature: float | None = None
    ) -> Responses:
        """Sample K responses to each prompt; prompts are encoded here, once, with the tokenizer's own begin token."""
        tokenizer = self.task.tokenizer
        encoded = [tuple(tokenizer.encode(prompt)) for prompt in prompts]
        ends, temperature = (int(tokenizer.eos_token_id),), self.temperature if temperature is None else temperature
        sampling = Sampling(samples, self.task.response_tokens, ends, temperature)
        drawn = generate(self.model, encoded, sampling, generator(rng))
        # In the order of the generated rows: all samples of the first prompt first.
        repeated = [(p, e) for p, e in zip(prompts, encoded, strict=True) for _ in range(samples)]
        texts, ids = zip(*repeated, strict=True)
        return Responses(texts, ids, drawn.tokens, drawn.mask, drawn.logp, drawn.ended)

    def start_logp(self, responses: Responses, temperature: float | None = None) -> Tensor:
        """(B, L) log-probabilities under the starting policy, without gradients."""
        temperature = self.temperature if temperature is None else temperature
        return all_logp(self.start, responses, temperature, self.part)

    def with_gold(self, responses: Responses) -> list[Response]:
        """As candidates, gold attached: for what is asked about, and for evaluation."""
        found = responses.candidates(self.task.tokenizer)
        gold = self.task.gold(found)
        return [replace(r, gold=gold[i : i + 1]) for i, r in enumerate(found)]

    def state(self) -> State:
        # Tied weights have one name here, and are saved once.
        return {name: p.detach().clone() for name, p in self.model.named_parameters()}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        for name, parameter in self.model.named_parameters():
            found = state.get(name)
            if found is None or found.shape != parameter.shape:
                raise ValueError(f"policy: {name} is missing or has another shape: it was made by other settings")
            parameter.copy_(found)  # in place: the optimiser holds these very tensors


def response_logp(model: PreTrainedModel, responses: Responses, temperature: float) -> Tensor:
    """(B, L) float32 log-probabilities of the responses' tokens, differentiable; 0 on padding.

    Rows are padded on the right, where a causal model never looks: no attention mask and no position ids are needed.
    The head runs on the real tokens of the responses only.
    """
    rows, steps = responses.mask.nonzero(as_tuple=True)  # (n,), (n,): the n real tokens, row by row
    prompts, lengths = pad_right(responses.prompt_tokens, responses.mask.device)
    places = lengths[rows] + steps  # (n,): the column of each, after its prompt
    ids = prompts.new_zeros(len(responses), int(places.max()) + 1)  # padded with 0, which is a valid id
    ids[:, : prompts.shape[1]] = prompts
    chosen = responses.tokens[rows, steps]
    ids[rows, places] = chosen
    hidden = model.base_model(input_ids=ids, use_cache=False).last_hidden_state
    logits = head_logits(model, hidden[rows, places - 1])  # (n, V): the state before a token predicts it
    # At the temperature of sampling, or the ratio is not 1 before the first step; in float32, whatever the model is.
    found = -torch.nn.functional.cross_entropy(logits.float() / temperature, chosen, reduction="none")
    return found.new_zeros(responses.mask.shape).masked_scatter(responses.mask, found)  # (n,) -> (B, L), row by row


@torch.no_grad()
def all_logp(model: PreTrainedModel, responses: Responses, temperature: float, part: int) -> Tensor:
    """`response_logp` without gradients, a part of the rows at a time."""
    found = torch.zeros(responses.mask.shape, device=responses.mask.device)
    for at, rows in responses.parts(part):
        found[at, : rows.mask.shape[1]] = response_logp(model, rows, temperature)  # a part is cut to its longest row
    return found


def head_logits(model: PreTrainedModel, hidden: Tensor) -> Tensor:
    """The language model's head, on hidden states of any shape (..., d)."""
    head = model.get_output_embeddings()  # type: ignore[no-untyped-call]
    logits: Tensor = head(hidden)
    return logits


@torch.no_grad()
def check_head(model: PreTrainedModel) -> None:
    """Raise `ConfigError` for models whose logits are more than their head's output (soft caps, scales)."""
    ids = torch.zeros(1, 4, dtype=torch.int64)
    direct = model(input_ids=ids, use_cache=False).logits
    ours = head_logits(model, model.base_model(input_ids=ids, use_cache=False).last_hidden_state)
    if not torch.allclose(direct, ours, atol=1e-4, rtol=1e-4):
        raise ConfigError(f"{type(model).__name__} does more to its logits than its head says; this is not supported")


def pad_right(rows: Sequence[Sequence[int]], device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """(N, L) int64 token ids, right-padded with 0, which is a valid id; and how many of each row are real (N,)."""
    width = max(map(len, rows))
    ids = torch.tensor([[*row, *[0] * (width - len(row))] for row in rows], dtype=torch.int64, device=device)
    return ids, torch.tensor([len(row) for row in rows], device=device)
