"""Behavioural cloning of texts: a small Llama-like model, made from a config and fitted by maximum likelihood.

What comes out is kept under a digest of everything that went in; a damaged copy is made anew.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, TypeAlias

import numpy as np
import tokenizers
import torch
import transformers
from platformdirs import user_cache_path
from pydantic import Field, model_validator
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from torch import Tensor
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

from prefrl.components import Settings
from prefrl.policies.pretrained import load_weights, quiet
from prefrl.seeding import draw_seed, threads
from prefrl.storage.files import DamagedError, verify, whole_folder
from prefrl.types import Fields

RECIPE = 1
"""Raise this when the same settings lead to another model: what older versions kept is then left alone."""
RECIPE_FILE = "RECIPE.json"
"""Of a shipped model: the digest of what it was made from."""
PAD, BOS, EOS = "<pad>", "<bos>", "<eos>"
IGNORED = -100
Writer: TypeAlias = Callable[[np.random.Generator], tuple[str, str]]
"""Draws one text, as the prompt and what follows it; the text is both put together."""


class CloningSettings(Settings):
    """The starting policy: its size, and how it learns to write like the texts it is shown."""

    layers: int = Field(4, ge=1)
    """Of the Llama-like network."""
    width: int = Field(128, ge=8)
    """Of its hidden states."""
    heads: int = Field(4, ge=1)
    """Of its attention."""
    vocabulary: int = Field(2048, ge=300)
    """The most tokens of the byte-level BPE; 256 of them are the bytes."""
    reviews: int = Field(40_000, ge=64)
    """How many texts are written to learn from; each is seen once."""
    batch_size: int = Field(8, ge=1)
    """Texts in a gradient step. Many small steps: with 16 texts a start now and then learns no topic, and is half as
    fluent."""
    learning_rate: float = Field(3e-3, gt=0)
    """AdamW's peak; it warms up over the first twentieth and falls to 0 along a cosine."""
    seed: int = Field(0, ge=0)
    """Of the texts, the weights and their order; a run's own seed does not change its starting policy."""
    cache: Path | None = None
    """The folder that keeps finished models; the user's cache folder when not given."""

    @model_validator(mode="after")
    def _whole_heads(self) -> CloningSettings:
        if self.width % (2 * self.heads):
            raise ValueError(f"width must be a multiple of 2 x heads, got {self.width} and {self.heads}")
        return self

    def build(
        self, write: Writer, source: str, shipped: Path | None = None
    ) -> tuple[LlamaForCausalLM, PreTrainedTokenizerFast]:
        """The model and its tokenizer: shipped, or from the cache if they are there and whole, else cloned now.

        `source` tells one writer from another; `shipped` is a folder that `ship` wrote.
        """
        if shipped is not None and json.loads((shipped / RECIPE_FILE).read_text()) == self.recipe(source):
            return _load(shipped)
        folder = (self.cache or user_cache_path("prefrl") / "models") / self.digest(source)
        if not folder.exists():
            _make(self, write, folder)
        try:
            return _load(folder)
        except DamagedError as error:
            Console(stderr=True).print(f"the kept starting policy is damaged ({error}); making it anew", soft_wrap=True)
            shutil.rmtree(folder)
            _make(self, write, folder)
            return _load(folder)

    def ship(self, write: Writer, source: str, folder: Path) -> None:
        """Write the model in half precision, to be installed with the package: 2 MB, and the same on every machine."""
        model, tokenizer = self.build(write, source)
        with whole_folder(folder) as work, quiet():
            copy.deepcopy(model).to(torch.float16).save_pretrained(work)  # type: ignore[arg-type]  # transformers wraps it
            tokenizer.save_pretrained(work)
            (work / RECIPE_FILE).write_text(json.dumps(self.recipe(source)))

    def recipe(self, source: str) -> str:
        """A digest of what is learned, and how: the settings and the writer's source."""
        return _digest(self._lasting(), source, RECIPE)

    def digest(self, source: str) -> str:
        """Of the settings, the writer's source, and the versions that decide the weights."""
        versions = [RECIPE, torch.__version__, transformers.__version__, tokenizers.__version__]
        return _digest(self._lasting(), source, versions)

    def _lasting(self) -> Fields:
        return self.model_dump(mode="json", exclude={"cache"})  # where a model is kept does not change it


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def _make(settings: CloningSettings, write: Writer, folder: Path) -> None:
    model, tokenizer = clone(settings, write)
    with whole_folder(folder) as work, quiet():
        model.save_pretrained(work)
        tokenizer.save_pretrained(work)


def _load(folder: Path) -> tuple[LlamaForCausalLM, PreTrainedTokenizerFast]:
    verify(folder)  # the name says what went in, not whether all of it is still there
    model: Any = load_weights(LlamaForCausalLM, folder, download=False)
    return model, PreTrainedTokenizerFast.from_pretrained(folder, local_files_only=True)


def clone(settings: CloningSettings, write: Writer) -> tuple[LlamaForCausalLM, PreTrainedTokenizerFast]:
    """Train the tokenizer and the model on new texts; the next token of whole texts is what is learned."""
    rng = np.random.default_rng(settings.seed)
    pairs = [write(rng) for _ in range(settings.reviews)]
    tokenizer = make_tokenizer([prompt + rest for prompt, rest in pairs], settings.vocabulary)
    rows = [tokenizer.encode(prompt) + encode_rest(tokenizer, rest) for prompt, rest in pairs]
    # transformers initialises from torch's global generator, which is put back for whoever else draws from it.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(draw_seed(rng))
        model = make_model(settings, tokenizer)
    batches = _batches(rows, settings.batch_size, rng)
    optimizer = torch.optim.AdamW(
        model.parameters(), settings.learning_rate, betas=(0.9, 0.98), weight_decay=0.01, fused=True
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, len(batches)))
    with progress(len(batches), Console(stderr=True)) as report, threads(1):
        for batch in batches:
            report.advance(_step(model, optimizer, batch))
            schedule.step()
    model.eval()  # type: ignore[no-untyped-call]
    return model, tokenizer


def make_tokenizer(texts: list[str], vocabulary: int) -> PreTrainedTokenizerFast:
    """A byte-level BPE with distinct tokens for padding, begin and end; encoding adds the begin token, once."""
    inner = Tokenizer(models.BPE())
    # No space in front: a response is encoded apart from its prompt, and must join it as it was written.
    inner.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    inner.decoder = decoders.ByteLevel()
    inner.train_from_iterator(
        texts,
        trainers.BpeTrainer(
            vocab_size=vocabulary,
            special_tokens=[PAD, BOS, EOS],
            initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),  # all bytes, so that any text can be encoded
            show_progress=False,
        ),
    )
    inner.post_processor = processors.TemplateProcessing(f"{BOS} $A", special_tokens=[(BOS, inner.token_to_id(BOS))])
    # Cleaning up would drop spaces before punctuation, and a decoded response would not be what was sampled.
    return PreTrainedTokenizerFast(  # type: ignore[no-untyped-call]
        tokenizer_object=inner, pad_token=PAD, bos_token=BOS, eos_token=EOS, clean_up_tokenization_spaces=False
    )


def encode_rest(tokenizer: PreTrainedTokenizerFast, text: str) -> list[int]:
    """What follows a prompt: no begin token, and an end token."""
    return [*tokenizer.encode(text, add_special_tokens=False), int(tokenizer.eos_token_id)]


def make_model(settings: CloningSettings, tokenizer: PreTrainedTokenizerFast) -> LlamaForCausalLM:
    """A Llama of the given size with random weights (torch's global generator), embeddings tied, no dropout."""
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=settings.width,
        intermediate_size=max(32, settings.width * 8 // 3 // 32 * 32),  # 8/3 of the width, as in Llama
        num_hidden_layers=settings.layers,
        num_attention_heads=settings.heads,
        max_position_embeddings=512,
        tie_word_embeddings=True,
        pad_token_id=tokenizer.pad_token_id,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
    )
    return LlamaForCausalLM(config)


def _batches(rows: list[list[int]], size: int, rng: np.random.Generator) -> list[Tensor]:
    """Right-padded batches of rows of like length, in random order; padding is `IGNORED`."""
    rows = sorted(rows, key=len)
    found = []
    for start in range(0, len(rows) - size + 1, size):  # the longest rows that fill no batch are left out
        some = rows[start : start + size]
        found.append(torch.tensor([row + [IGNORED] * (len(some[-1]) - len(row)) for row in some]))
    return [found[i] for i in rng.permutation(len(found))]


def _rate(step: int, steps: int) -> float:
    warm = max(1, steps // 20)
    return min((step + 1) / warm, 0.5 + 0.5 * math.cos(math.pi * step / steps))  # step + 1: the first step moves too


def _step(model: LlamaForCausalLM, optimizer: torch.optim.Optimizer, batch: Tensor) -> float:
    """One gradient step on a batch; its loss in nats a token. Padding is on the right, so no mask is needed."""
    # IGNORED is no token: id 0 stands in for it where it is read, and as a target it does not count.
    logits = model(input_ids=batch[:, :-1].clamp(min=0), use_cache=False).logits
    loss = torch.nn.functional.cross_entropy(logits.flatten(0, 1), batch[:, 1:].flatten(), ignore_index=IGNORED)
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0, error_if_nonfinite=True)
    optimizer.step()
    return float(loss.detach())


class _Report(Protocol):
    def advance(self, loss: float) -> None: ...


class _Lines:
    """Ten lines in all, where there is nothing to draw on."""

    def __init__(self, console: Console, steps: int) -> None:
        self._console, self._steps, self._done, self._begin = console, steps, 0, perf_counter()

    def advance(self, loss: float) -> None:
        self._done += 1
        tenths = 10 * self._done // self._steps
        if tenths > 10 * (self._done - 1) // self._steps:
            speed = self._done / max(perf_counter() - self._begin, 1e-9)
            left = (self._steps - self._done) / speed
            note = f"{self._done} of {self._steps} steps, {speed:.1f} steps/s, loss {loss:.2f}, {left:.0f} s left"
            self._console.print(f"cloning the grammar: {note}", soft_wrap=True)


class _Bar:
    def __init__(self, progress: Progress, steps: int) -> None:
        self._progress = progress
        self._task = progress.add_task("cloning the grammar", total=steps, note="")

    def advance(self, loss: float) -> None:
        speed = self._progress.tasks[self._task].speed or 0.0
        self._progress.update(self._task, advance=1, note=f"{speed:.1f} steps/s, loss {loss:.2f}")


@contextmanager
def progress(steps: int, console: Console) -> Iterator[_Report]:
    """A bar on a terminal, lines elsewhere."""
    if not console.is_terminal:
        console.print(f"cloning the grammar into a starting policy, {steps} steps (once; it is kept)", soft_wrap=True)
        yield _Lines(console, steps)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        yield _Bar(bar, steps)
