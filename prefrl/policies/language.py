"""A language model as a policy."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor
from transformers import GenerationConfig, PreTrainedModel

from prefrl.components import ConfigError, Settings
from prefrl.distributed import joined, world
from prefrl.policies.exact import check_exact
from prefrl.policies.generate import Sampling, generate
from prefrl.policies.logprobs import (
    Shortcuts,
    all_logp,
    in_all_rows,
    logp_of_states,
    response_logp,
    response_states,
    shortcuts_of,
)
from prefrl.policies.pretrained import beginning, context_of, quiet
from prefrl.policies.responses import Responses
from prefrl.protocols import TextTask
from prefrl.seeding import generator, to_numpy
from prefrl.storage.files import whole_folder
from prefrl.types import Response, State

if TYPE_CHECKING:
    from prefrl.policies.critic import Critic
    from prefrl.policies.spread import Spread

DIGESTED = 1000
"""About this many numbers of each matrix are enough to tell models apart."""


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
    at_once: int = Field(256, ge=1)
    """The most responses that are written at the same time (but never fewer than one prompt's): as some end, others are
    begun. Changes memory and speed, and nothing else but rounding."""
    shard: Literal["none", "fsdp2"] = "none"
    """What each of several ranks keeps: the whole model, or a share of every weight (`fsdp2`), for models that do not
    fit; that is slower."""

    @model_validator(mode="after")
    def _room_for_all(self) -> LanguageSettings:
        if self.shard != "none" and self.chunk < 4:
            raise ValueError(f"shard={self.shard} wants a chunk of at least 4, got {self.chunk}")  # for equal parts
        return self


@contextmanager
def enough_memory(setting: str, value: int) -> Iterator[None]:
    """Say which setting halves what is needed: MemoryError takes the place of what torch raises."""
    try:
        yield
    except RuntimeError as error:  # torch.OutOfMemoryError, of GPUs, is one
        if not isinstance(error, torch.OutOfMemoryError) and "allocate memory" not in str(error):
            raise
        raise MemoryError(
            f"memory ran out: halve {setting}, which is {value}; learner.policy.train=lora needs less throughout"
        ) from error


class Whole:
    """How each rank keeps its models: whole."""

    fast = True

    def place(self, model: PreTrainedModel, device: torch.device) -> None:
        """Move a model to a device."""
        model.to(device)  # type: ignore[arg-type]  # transformers wraps torch's method

    def running(self, model: PreTrainedModel) -> AbstractContextManager[None]:
        """Meanwhile a model is run, without gradients."""
        return nullcontext()

    def whole(self, value: Tensor) -> Tensor:
        """A copy of a parameter, or of what belongs to it."""
        return value.clone()

    def share(self, value: Tensor, of: Tensor) -> Tensor:
        """This rank's share of a whole tensor."""
        return value


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
        self._at_once = settings.at_once
        self.keeping = _keeping(settings)
        self.critic: Critic | None = None
        self._start_digest = ""
        self.model = task.model(frozen=settings.train == "lora")
        self._shortcuts = shortcuts_of(self.model) if self.keeping.fast else Shortcuts()
        check_exact(self.model, self._probe)
        if settings.train == "full":
            self.start = task.model(frozen=True)
        else:
            from prefrl.policies.lora import add_adapters  # peft takes seconds to load

            add_adapters(self.model, settings.lora_rank, settings.lora_targets, rng, "learner.policy")
            self.start = self.model

    @property
    def device(self) -> torch.device:
        return self.model.device

    @property
    def spread(self) -> bool:
        """Whether each of several ranks keeps a share of every weight alone."""
        return not isinstance(self.keeping, Whole)

    @property
    def least_rows(self) -> int:
        """How many rows a gradient step must have: one for each rank, where all have to take part."""
        return world().size if self.spread else 1

    def check_share(self, rows: int) -> None:
        """Raises `ConfigError` where a gradient step on so many rows leaves a rank without any that has to have one."""
        if rows < self.least_rows:
            raise ConfigError(
                f"learner.policy.shard=fsdp2: a gradient step on {rows} rows is too small for {world().size} ranks; "
                "expected at least one for each: make learner's batches larger, or start fewer ranks"
            )

    def to(self, device: torch.device) -> None:
        """Move everything to a device, for good."""
        self._start_digest = self.start_digest() if self.spread else ""  # while the weights are here
        for model in (self.model, self.start) if self.start is not self.model else (self.model,):
            self.keeping.place(model, device)
        if self.critic is not None:
            self.critic.to(device)

    def parameters(self) -> list[torch.nn.Parameter]:
        return list(self._trained().values())

    def log_prob(self, inputs: Responses) -> tuple[Tensor, None]:
        with enough_memory("learner.policy.chunk", self.part):
            return response_logp(self.model, inputs, self.temperature, self._shortcuts), None

    def values(self, inputs: Responses) -> Tensor:
        with enough_memory("learner.policy.chunk", self.part):
            found: Tensor = self._critic()(self.model, inputs)
        return found

    def log_prob_and_values(self, inputs: Responses) -> tuple[Tensor, None, Tensor]:
        critic = self._critic()
        if critic.trunk is not None or not self._shortcuts.head_alone:
            return *self.log_prob(inputs), self.values(inputs)
        with enough_memory("learner.policy.chunk", self.part):
            states = response_states(self.model, inputs, self._shortcuts)
            logp = logp_of_states(self.model, states, inputs, self.temperature)
            return logp, None, critic.of_states(states, inputs.mask)

    def all_values(self, responses: Responses) -> Tensor:
        """(B, L) values, without gradients."""
        return in_all_rows(self.values, responses, self.part)

    def add_critic(self, own: bool) -> None:
        """Let it learn values as well: from its own hidden states, or with a network that starts as a copy of it."""
        from prefrl.policies.critic import Critic

        if self.spread:
            raise ConfigError("a critic is kept whole: with learner.policy.shard set choose an algorithm without one")
        trunk = cast("PreTrainedModel", self.task.model().base_model) if own else None
        width = self.model.get_output_embeddings().weight.shape[1]  # type: ignore[no-untyped-call]
        self.critic = Critic(width, trunk, self._shortcuts)

    def critic_fits(self, trunk: State) -> bool:
        """Whether such weights have the names and the shapes of those of the critic's own network."""
        own = self._critic().trunk
        assert own is not None
        return {n: p.shape for n, p in own.state_dict().items()} == {n: p.shape for n, p in trunk.items()}

    def start_critic(self, trunk: State, weight: Tensor, bias: float) -> None:
        """Let a critic with a network of its own go on from such weights, with a head (d,) and its bias."""
        critic = self._critic()
        assert critic.trunk is not None
        critic.trunk.load_state_dict(trunk)
        with torch.no_grad():
            critic.head.weight.copy_(weight)  # (d,) -> (1, d)
            critic.head.bias.fill_(bias)

    def respond(
        self, prompts: Sequence[str], samples: int, rng: np.random.Generator, sampling: Sampling | None = None
    ) -> Responses:
        """Sample K responses to each prompt; prompts are encoded here, once, as the task says.

        `sampling`: otherwise than by the policy's own temperature.
        """
        return self._written(self.model, prompts, sampling or self.sampling(samples), rng)

    def respond_at_start(self, prompts: Sequence[str], samples: int, rng: np.random.Generator) -> Responses:
        """The same of the starting policy."""
        with self._at_the_start():
            return self._written(self.start, prompts, self.sampling(samples), rng)

    def _written(
        self, model: PreTrainedModel, prompts: Sequence[str], sampling: Sampling, rng: np.random.Generator
    ) -> Responses:
        encoded = [self.opened(prompt) for prompt in prompts]
        running, fast, samples = self.keeping.running(model), self.keeping.fast, sampling.samples
        with enough_memory("learner.policy.at_once", self._at_once):
            drawn = generate(model, encoded, sampling, generator(rng), fast, self._at_once, running)
        # In the order of the generated rows: all samples of the first prompt first.
        repeated = [(p, e) for p, e in zip(prompts, encoded, strict=True) for _ in range(samples)]
        texts, ids = zip(*repeated, strict=True)
        return Responses(texts, ids, drawn.tokens, drawn.mask, drawn.logp, drawn.ended)

    def opened(self, prompt: str) -> tuple[int, ...]:
        """The tokens that the model goes on from. Raises `ValueError` where its context has no room for a response."""
        ids = self.task.encode(prompt)
        self.check_room(len(ids) + self.task.response_tokens, prompt)
        return ids

    def sampling(self, samples: int, temperature: float | None = None) -> Sampling:
        """How the raw policy draws K responses to a prompt, at its own temperature unless another is given."""
        temperature = self.temperature if temperature is None else temperature
        return Sampling(samples, self.task.response_tokens, self.task.ends, temperature)

    def start_logp(self, responses: Responses, temperature: float | None = None) -> Tensor:
        """(B, L) log-probabilities under the starting policy, without gradients."""
        self.check_room(int(responses.lengths().max()), written=True)
        temperature = self.temperature if temperature is None else temperature
        with self._at_the_start(), enough_memory("learner.policy.chunk", self.part):
            return self._all_logp(self.start, responses, temperature)

    @torch.no_grad()
    def logp_at(self, values: State, responses: Responses) -> Tensor:
        """(B, L) log-probabilities with other values of what learning changes, as in `state`; without gradients."""
        own = self.state()
        self.load(values)
        try:
            return self._all_logp(self.model, responses, self.temperature)
        finally:
            self.load(own)

    def with_gold(self, responses: Responses) -> list[Response]:
        """As candidates, gold attached: for what is asked about, and for evaluation."""
        found = responses.candidates(self.task.tokenizer)
        gold = self.task.gold(found)
        return [replace(r, gold=gold[i : i + 1]) for i, r in enumerate(found)]

    def start_digest(self) -> str:
        """sha256 over names and samples of the starting policy's weights, in the precision that all runs have."""
        if self._start_digest:
            return self._start_digest
        found = hashlib.sha256()
        for name, value in self.start.named_parameters():
            if "lora_" not in name:
                some = value.detach().flatten()[:: max(1, value.numel() // DIGESTED)].bfloat16()
                found.update(name.replace("base_layer.", "").encode())
                found.update(to_numpy(some.view(torch.int16)).tobytes())
        return found.hexdigest()

    def save(self, folder: Path, adapter: bool = False) -> None:
        """Write what transformers' `from_pretrained` loads: the whole model, or its adapters alone for peft's."""
        save_model(self.model, self.task, folder, adapter)

    def state(self) -> State:
        """What learning changes."""
        return {name: self.keeping.whole(p.detach()) for name, p in self._trained().items()}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        for name, parameter in self._trained().items():
            found = state.get(name)
            if found is None or found.shape != parameter.shape:
                raise ValueError(f"policy: {name} is missing or has another shape: it was made by other settings")
            # In place: the optimiser holds these very tensors.
            parameter.copy_(self.keeping.share(found, parameter))

    def check_room(self, tokens: int, prompt: str = "", written: bool = False) -> None:
        """Raises `ValueError` where the model's context has no room for so many tokens; `written`: the response is
        there already, and no setting shortens it."""
        context = context_of(self.model)
        if context is not None and tokens > context:
            if written:
                need, advice = "need", "shorten them or leave them out, or choose a model with a longer context"
            else:
                need, advice = "need up to", "leave that prompt out, or lower task.response_tokens"
            raise ValueError(
                f"a prompt and its response{beginning(prompt)} {need} {tokens} tokens, and the model's context has "
                f"{context}: {advice}"
            )

    def _trained(self) -> dict[str, torch.nn.Parameter]:
        """By name. Tied weights have one name here."""
        critic = self.critic.named_parameters(prefix="critic") if self.critic else ()
        return {name: p for name, p in (*self.model.named_parameters(), *critic) if p.requires_grad}

    def _critic(self) -> Critic:
        if self.critic is None:
            raise ValueError("a language model without a critic has no values: set the weight of its loss to 0")
        return self.critic

    def _all_logp(self, model: PreTrainedModel, responses: Responses, temperature: float) -> Tensor:
        running = self.keeping.running(model)
        return all_logp(model, responses, temperature, self.part, self._shortcuts, running)

    def _at_the_start(self) -> AbstractContextManager[None]:
        if self.start is not self.model:
            return nullcontext()
        from prefrl.policies.lora import without_adapters

        return without_adapters(self.model)

    def _probe(self, prompts: Sequence[Sequence[int]], tokens: Tensor, mask: Tensor) -> Tensor:
        rows = Responses(("",) * len(prompts), tuple(map(tuple, prompts)), tokens, mask, mask.float(), mask[:, -1])
        return response_logp(self.model, rows, 1.0, self._shortcuts)


def _keeping(settings: LanguageSettings) -> Whole | Spread:
    if settings.shard == "none" or joined().size == 1:
        return Whole()
    from prefrl.policies.spread import Spread  # torch takes a second to load it

    return Spread()


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
