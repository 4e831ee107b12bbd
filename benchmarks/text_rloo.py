"""One RLOO or GRPO update of a Llama: prefrl's text learner against TRL's trainers, at equal work.

    python benchmarks/text_rloo.py [--size 1m|13m] [--algorithm rloo|grpo] [--prompt-tokens N] [--short]

16 prompts of 8 tokens, or as many as said, x 4 responses of 48 tokens, float32; see text_updates.py. `ratio` is peer /
ours: above 1, prefrl needs fewer CPU seconds.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from text_updates import Update, compare, options_of

PROMPTS, SAMPLES, NEW_TOKENS, WORDS, PROMPT_TOKENS = 16, 4, 48, 2048, 8
SIZES = {"1m": (4, 128, 4, 2048), "13m": (6, 384, 6, 8192)}
"""Layers, width, heads, vocabulary."""


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--size", choices=SIZES, default="1m")
    parser.add_argument("--algorithm", choices=("rloo", "grpo"), default="rloo")
    parser.add_argument("--prompt-tokens", type=int, default=PROMPT_TOKENS, help="up to 200")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder), options.size, options.prompt_tokens)
        work = Update(folder, PROMPTS, SAMPLES, NEW_TOKENS, algorithm=options.algorithm)
        found = compare(work, options.peers, 5 if options.short else 20)
    said = (
        f"one {options.algorithm.upper()} update, {options.size}, {PROMPTS} prompts of {options.prompt_tokens} tokens "
        f"x {SAMPLES} responses of {NEW_TOKENS}, fp32"
    )
    print(json.dumps({"name": f"text_rloo: {said}"} | found | {"short": options.short}))


def make_model(folder: Path, size: str, prompt_tokens: int = PROMPT_TOKENS, ends_after: int = 0) -> None:
    """Random weights, a tokenizer of whole words, t3 ... t2047, and prompts, for both sides to read.

    `ends_after`: let every token be the end token with a chance of 1 in so many.
    """
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

    torch.manual_seed(0)
    layers, width, heads, vocabulary = SIZES[size]
    config = LlamaConfig(
        vocab_size=vocabulary,
        hidden_size=width,
        intermediate_size=width * 43 // 16,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        max_position_embeddings=256,
        tie_word_embeddings=True,
        pad_token_id=0,
        bos_token_id=1,
        eos_token_id=2,
    )
    model = LlamaForCausalLM(config)
    if ends_after:
        _let_it_end(model, ends_after)
    model.save_pretrained(folder)
    special = ["<pad>", "<begin>", "<end>"]  # no word may begin with one: "t1" would be found in "t17"
    table = {word: i for i, word in enumerate([*special, *(f"t{i}" for i in range(3, WORDS))])}
    words = Tokenizer(models.WordLevel(table, unk_token="t3"))
    words.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    names = dict(zip(("pad_token", "bos_token", "eos_token"), special, strict=True))
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, **names)
    tokenizer.save_pretrained(folder)
    prompts = [" ".join(f"t{10 + (997 * i + 7 * j) % (WORDS - 10)}" for j in range(prompt_tokens)) for i in range(997)]
    (folder / "prompts.json").write_text(json.dumps(prompts))


def _let_it_end(model, after: int) -> None:  # type: ignore[no-untyped-def]
    """One direction is in every embedding, so in every state; the end token's row says how much it counts."""
    import torch

    with torch.no_grad():
        table = model.get_input_embeddings().weight  # the head's as well
        direction = torch.nn.functional.normalize(torch.randn(table.shape[1]), dim=0)
        table += direction
        ids = torch.arange(3, 67)[None]
        along = (model.base_model(ids).last_hidden_state @ direction).mean()
        table[2] += direction * torch.log(torch.tensor(len(table) / after)) / along


if __name__ == "__main__":
    main()
