"""Responses as tensors: sampled once, scored by forward passes, never decoded and encoded again in between."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase

from prefrl.protocols import TextTask
from prefrl.types import Response


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

    @property
    def repeat_prompts(self) -> bool:
        """Whether some prompt has several rows."""
        return len(set(self.prompt_tokens)) < len(self)

    def lengths(self) -> Tensor:
        """(B,) tokens of prompt and response together."""
        return self.mask.sum(1) + self.mask.new_tensor([len(p) for p in self.prompt_tokens], dtype=torch.int64)

    def order(self) -> Tensor:
        """(B,): rows of one prompt together, which is then run once, and prompts with rows of like length."""
        lengths, longest = self.lengths().tolist(), dict[tuple[int, ...], int]()
        for prompt, length in zip(self.prompt_tokens, lengths, strict=True):
            longest[prompt] = max(length, longest.get(prompt, 0))
        keys = [(longest[p], p, length) for p, length in zip(self.prompt_tokens, lengths, strict=True)]
        return torch.tensor(sorted(range(len(keys)), key=keys.__getitem__), device=self.mask.device)

    def parts(self, size: int) -> Iterator[tuple[Tensor, Responses]]:
        """(Indices, rows) of at most so many at a time, in that order."""
        for at in self.order().split(size):  # type: ignore[no-untyped-call]
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


def pad_right(rows: Sequence[Sequence[int]], device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """(N, L) int64 token ids, right-padded with 0, which is a valid id; and how many of each row are real (N,)."""
    width = max(map(len, rows))
    ids = torch.tensor([[*row, *[0] * (width - len(row))] for row in rows], dtype=torch.int64, device=device)
    return ids, torch.tensor([len(row) for row in rows], device=device)
