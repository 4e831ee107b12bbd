"""A language model as a policy, and responses as tensors: sampled once, scored by forward passes, never decoded and
encoded again in between."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from transformers import GenerationConfig, PreTrainedModel, PreTrainedTokenizerBase

from prefrl.components import Settings
from prefrl.distributed import world
from prefrl.policies.exact import check_exact, rows_of_embedding
from prefrl.policies.generate import Sampling, generate, tempered
from prefrl.policies.pretrained import context_of, quiet
from prefrl.protocols import TextTask
from prefrl.seeding import generator
from prefrl.storage.files import whole_folder
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
    def of(cls, candidates: Sequence[Response], task: TextTask, device: torch.device | None = None) -> Responses:
        """Responses that were sampled as they were; those that came as text alone are encoded, an end token added."""
        pairs = []
        for one in candidates:
            # Text that is encoded anew can merge across the border, into tokens that nobody sampled.
            prompt = one.prompt_tokens or task.encode(one.prompt)
            tokens = one.tokens or (*task.tokenizer.encode(one.text, add_special_tokens=False), task.ends[0])
            pairs.append((prompt, tokens))
        padded, lengths = pad_right([tokens for _, tokens in pairs], device)
        mask = torch.arange(padded.shape[1], device=device) < lengths[:, None]
        ended = torch.tensor([tokens[-1] in task.ends for _, tokens in pairs], device=device)
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


class LanguageSettings(Settings):
    """What of a language model is trained, and how much of it at once."""

    train: Literal["full", "lora"] = "full"
    """What learning changes: everything, or low-rank adapters alone (LoRA), which take far less memory."""
    lora_rank: int = Field(16, ge=1)
    """The rank of the adapters."""
    lora_targets: Literal["all-linear", "default"] = "all-linear"
    """Which matrices get an adapter: all of them, or those that peft knows as usual for the architecture."""
    chunk: int = Field(64, ge=2)
    """Responses in one pass of a network while learning: changes memory and speed, and nothing else but rounding."""


class LanguagePolicy:
    """A `prefrl.protocols.Policy` of `Responses`: a causal language model beside the one that it started from.

    Both stay in evaluation mode throughout, so the probability ratio is 1 (to rounding) before a batch's first step.
    `temperature` is that of sampling and of every log-probability, unless another is asked for. With LoRA the adapters
    alone are trained (their start is drawn from `rng`), and the model without them is the one that it started from.
    Raises `ConfigError` for models that are not what is computed here, see `exact`.
    """

    def __init__(
        self, task: TextTask, temperature: float, settings: LanguageSettings, rng: np.random.Generator
    ) -> None:
        self.task, self.temperature, self.part = task, temperature, settings.chunk
        self.model = task.model()
        self._head_alone = head_alone(self.model)
        check_exact(self.model, self._probe)
        if settings.train == "full":
            self.start = task.model().requires_grad_(False)  # a second copy of the weights
            return
        from prefrl.policies.lora import add_adapters  # peft takes seconds to load

        add_adapters(self.model, settings.lora_rank, settings.lora_targets, rng, "learner.policy")
        self.start = self.model

    @property
    def device(self) -> torch.device:
        return self.model.device

    def to(self, device: torch.device) -> None:
        """Move both models to a device."""
        for model in (self.model, self.start):
            model.to(device)  # type: ignore[arg-type]  # transformers wraps torch's method

    def parameters(self) -> list[torch.nn.Parameter]:
        return list(self._trained().values())

    def log_prob(self, inputs: Responses) -> tuple[Tensor, None]:
        return response_logp(self.model, inputs, self.temperature, self._head_alone), None

    def values(self, inputs: Responses) -> Tensor:
        raise ValueError("a language model without a critic has no values: set the weight of the critic's loss to 0")

    def respond(
        self, prompts: Sequence[str], samples: int, rng: np.random.Generator, sampling: Sampling | None = None
    ) -> Responses:
        """Sample K responses to each prompt; prompts are encoded here, once, as the task says.

        `sampling`: otherwise than by the policy's own temperature.
        """
        encoded = [self.opened(prompt) for prompt in prompts]
        sampling = sampling or self.sampling(samples)
        drawn = generate(self.model, encoded, sampling, generator(rng))
        # In the order of the generated rows: all samples of the first prompt first.
        repeated = [(p, e) for p, e in zip(prompts, encoded, strict=True) for _ in range(samples)]
        texts, ids = zip(*repeated, strict=True)
        return Responses(texts, ids, drawn.tokens, drawn.mask, drawn.logp, drawn.ended)

    def opened(self, prompt: str) -> tuple[int, ...]:
        """The tokens that the model goes on from. Raises `ValueError` where its context has no room for a response."""
        ids = self.task.encode(prompt)
        self._check_room(len(ids) + self.task.response_tokens)
        return ids

    def sampling(self, samples: int, temperature: float | None = None) -> Sampling:
        """How the raw policy draws K responses to a prompt, at its own temperature unless another is given."""
        temperature = self.temperature if temperature is None else temperature
        return Sampling(samples, self.task.response_tokens, self.task.ends, temperature)

    def start_logp(self, responses: Responses, temperature: float | None = None) -> Tensor:
        """(B, L) log-probabilities under the starting policy, without gradients."""
        self._check_room(int(responses.lengths().max()))
        temperature = self.temperature if temperature is None else temperature
        with self._at_the_start():
            return all_logp(self.start, responses, temperature, self.part, self._head_alone)

    @torch.no_grad()
    def logp_at(self, values: State, responses: Responses) -> Tensor:
        """(B, L) log-probabilities with other values of what learning changes, as in `state`; without gradients."""
        own = self.state()
        self.load(values)
        try:
            return all_logp(self.model, responses, self.temperature, self.part, self._head_alone)
        finally:
            self.load(own)

    def with_gold(self, responses: Responses) -> list[Response]:
        """As candidates, gold attached: for what is asked about, and for evaluation."""
        found = responses.candidates(self.task.tokenizer)
        gold = self.task.gold(found)
        return [replace(r, gold=gold[i : i + 1]) for i, r in enumerate(found)]

    def save(self, folder: Path, adapter: bool = False) -> None:
        """Write what transformers' `from_pretrained` loads: the whole model, or its adapters alone for peft's."""
        save_model(self.model, self.task, folder, adapter)

    def state(self) -> State:
        """What learning changes."""
        return {name: p.detach().clone() for name, p in self._trained().items()}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        for name, parameter in self._trained().items():
            found = state.get(name)
            if found is None or found.shape != parameter.shape:
                raise ValueError(f"policy: {name} is missing or has another shape: it was made by other settings")
            parameter.copy_(found)  # in place: the optimiser holds these very tensors

    def _check_room(self, tokens: int) -> None:
        context = context_of(self.model)
        if context is not None and tokens > context:
            raise ValueError(
                f"a prompt and its response need up to {tokens} tokens, and the model's context has {context}: leave "
                "that prompt out, or lower task.response_tokens"
            )

    def _trained(self) -> dict[str, torch.nn.Parameter]:
        """By name. Tied weights have one name here."""
        return {name: p for name, p in self.model.named_parameters() if p.requires_grad}

    def _at_the_start(self) -> AbstractContextManager[None]:
        if self.start is not self.model:
            return nullcontext()
        from prefrl.policies.lora import without_adapters

        return without_adapters(self.model)

    def _probe(self, prompts: Sequence[Sequence[int]], tokens: Tensor, mask: Tensor) -> Tensor:
        rows = Responses(("",) * len(prompts), tuple(map(tuple, prompts)), tokens, mask, mask.float(), mask[:, -1])
        return response_logp(self.model, rows, 1.0, self._head_alone)


def response_logp(model: PreTrainedModel, responses: Responses, temperature: float, head_alone: bool = True) -> Tensor:
    """(B, L) float32 log-probabilities of the responses' tokens, differentiable; 0 on padding.

    Rows are padded on the right, where a causal model never looks: no attention mask and no position ids are needed.
    Where the logits are the head's output alone, it runs on the real tokens of the responses only.
    """
    rows, steps = responses.mask.nonzero(as_tuple=True)  # (n,), (n,): the n real tokens, row by row
    prompts, lengths = pad_right(responses.prompt_tokens, responses.mask.device)
    places = lengths[rows] + steps  # (n,): the column of each, after its prompt
    ids = prompts.new_zeros(len(responses), int(places.max()) + 1)  # padded with 0, which is a valid id
    ids[:, : prompts.shape[1]] = prompts
    chosen = responses.tokens[rows, steps]
    ids[rows, places] = chosen
    if head_alone:
        hidden = model.base_model(input_ids=ids, use_cache=False).last_hidden_state
        logits = head_logits(model, hidden[rows, places - 1])  # (n, V): the state before a token predicts it
    else:
        first = int(lengths.min()) - 1  # the first column whose logits are wanted
        kept = model(input_ids=ids, use_cache=False, logits_to_keep=ids.shape[1] - first).logits
        logits = kept[rows, places - 1 - first]
    # At the temperature of sampling, or the ratio is not 1 before the first step; in float32, whatever the model is.
    found = -torch.nn.functional.cross_entropy(tempered(logits, temperature), chosen, reduction="none")
    return found.new_zeros(responses.mask.shape).masked_scatter(responses.mask, found)  # (n,) -> (B, L), row by row


@torch.no_grad()
def all_logp(
    model: PreTrainedModel, responses: Responses, temperature: float, part: int, head_alone: bool = True
) -> Tensor:
    """`response_logp` without gradients, a part of the rows at a time; ranks share the rows."""
    found = torch.zeros(responses.mask.shape, device=responses.mask.device)[world().mine]
    if len(found):
        mine = responses if world().size == 1 else responses.rows(torch.arange(len(responses))[world().mine])
        for at, rows in mine.parts(part):
            # a part is cut to its longest row
            found[at, : rows.mask.shape[1]] = response_logp(model, rows, temperature, head_alone)
    return world().whole(found, len(responses))


def head_logits(model: PreTrainedModel, hidden: Tensor) -> Tensor:
    """The language model's head, on hidden states of any shape (..., d)."""
    head = model.get_output_embeddings()  # type: ignore[no-untyped-call]
    logits: Tensor = head(hidden)
    return logits


@torch.no_grad()
def head_alone(model: PreTrainedModel) -> bool:
    """Whether a model's logits are its head's output, and nothing is done to them (soft caps, scales)."""
    ids = torch.arange(8, device=model.device)[None] * 7919 % rows_of_embedding(model)  # tokens that are far apart
    direct = model(input_ids=ids, use_cache=False).logits
    ours = head_logits(model, model.base_model(input_ids=ids, use_cache=False).last_hidden_state)
    # Hardly a cap shows on small logits: the bits must be the same, or nearly.
    return bool((direct - ours).abs().max() <= 1e-6 * direct.abs().max())


def save_model(model: PreTrainedModel, task: TextTask, folder: Path, adapter: bool) -> None:
    """Write a model, or its adapters alone, with its tokenizer and what ends its responses."""
    with whole_folder(folder) as work, quiet():
        if adapter:
            from prefrl.policies.lora import save_adapters

            save_adapters(model, work)
        else:
            merged_of(model).save_pretrained(work)
            # Its own: sampling was from the raw policy, and what others set as defaults transformers may not even save.
            special = {"eos_token_id": list(task.ends), "pad_token_id": task.tokenizer.pad_token_id}
            GenerationConfig(**special).save_pretrained(work)  # type: ignore[no-untyped-call]
        task.tokenizer.save_pretrained(work)


def merged_of(model: PreTrainedModel) -> PreTrainedModel:
    """The model itself, or a copy that its adapters are added to."""
    if not any("lora_" in name for name, _ in model.named_parameters()):
        return model
    from prefrl.policies.lora import merged  # peft takes seconds to load

    return merged(model)


def pad_right(rows: Sequence[Sequence[int]], device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """(N, L) int64 token ids, right-padded with 0, which is a valid id; and how many of each row are real (N,)."""
    width = max(map(len, rows))
    ids = torch.tensor([[*row, *[0] * (width - len(row))] for row in rows], dtype=torch.int64, device=device)
    return ids, torch.tensor([len(row) for row in rows], device=device)
