"""Sampling 64 responses of 48 tokens: prefrl's decode loop against transformers' `generate`, at equal work.

    python benchmarks/text_generate.py [--size 1m|13m] [--family llama|qwen|mistral|phi|gpt2|neox] [--shared] [--short]

The same weights (random, float32), the same prompts of 8 tokens, one thread, no end token, pure sampling. The two take
turns in one process; CPU seconds are compared by their medians. `--shared`: 16 prompts with 4 responses each, which
`generate` gets as num_return_sequences=4. `ratio` is peer / ours: above 1, prefrl needs fewer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from transformers import CONFIG_MAPPING, AutoModelForCausalLM

from prefrl.policies.generate import Sampling, generate

ROWS, SAMPLES, PROMPT_TOKENS, NEW_TOKENS = 64, 4, 8, 48
SIZES = {"1m": (4, 128, 4, 2048), "13m": (6, 384, 6, 8192)}
"""Layers, width, heads, vocabulary."""
FAMILIES = {
    "llama": "llama",
    "qwen": "qwen2",
    "mistral": "mistral",
    "phi": "phi",
    "gpt2": "gpt2",
    "neox": "gpt_neox",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=SIZES, default="1m")
    parser.add_argument("--family", choices=FAMILIES, default="llama")
    parser.add_argument("--shared", action="store_true", help="four responses to each of 16 prompts")
    parser.add_argument("--short", action="store_true", help="fewer repetitions: under two minutes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model, samples = make(options.family, options.size), SAMPLES if options.shared else 1
    order = torch.Generator().manual_seed(0)
    prompts = torch.randint(3, model.config.vocab_size, (ROWS // samples, PROMPT_TOKENS), generator=order)
    sides: dict[str, Callable[[], int]] = {
        "ours": lambda: ours(model, prompts, samples, order),
        "peer": lambda: peer(model, prompts, samples),
    }
    found = compare(sides, 5 if options.short else 20)
    name = f"text_generate: {options.family}, {options.size}, {ROWS} x {NEW_TOKENS} tokens, fp32"
    shared = ", shared prompts" if options.shared else ""
    print(json.dumps({"name": name + shared, "unit": "CPU s"} | found | {"equal_work": True, "short": options.short}))


def make(family: str, size: str) -> Any:
    """A model of a family with random weights."""
    layers, width, heads, vocabulary = SIZES[size]
    config = CONFIG_MAPPING[FAMILIES[family]](
        vocab_size=vocabulary,
        hidden_size=width,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        num_key_value_heads=heads,
        intermediate_size=width * 8 // 3 if family in ("llama", "qwen", "mistral") else width * 4,
        max_position_embeddings=256,
        n_embd=width,
        n_layer=layers,
        n_head=heads,
        n_positions=256,
        pad_token_id=0,
        bos_token_id=1,
        eos_token_id=2,
    )
    torch.manual_seed(0)
    model: Any = AutoModelForCausalLM.from_config(config)  # type: ignore[no-untyped-call]
    return model.eval()


def ours(model: Any, prompts: torch.Tensor, samples: int, order: torch.Generator) -> int:
    found = generate(model, prompts.tolist(), Sampling(samples, NEW_TOKENS, ()), order)
    return int(found.mask.sum())


def peer(model: Any, prompts: torch.Tensor, samples: int) -> int:
    found = model.generate(
        prompts,
        attention_mask=torch.ones_like(prompts),
        do_sample=True,
        top_k=0,
        num_return_sequences=samples,
        min_new_tokens=NEW_TOKENS,
        max_new_tokens=NEW_TOKENS,
    )
    return int(found[:, prompts.shape[1] :].numel())


def compare(sides: dict[str, Callable[[], int]], repetitions: int) -> dict[str, Any]:
    """Let both sides generate in turn; the first two turns are for warming up."""
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for i in range(repetitions + 2):
        for name in sorted(sides, reverse=bool(i % 2)):
            begin = time.process_time()
            tokens = sides[name]()
            spent = time.process_time() - begin
            if tokens != ROWS * NEW_TOKENS:
                raise RuntimeError(f"{name} generated {tokens} tokens: the work is not equal")
            seconds[name] += [spent] if i >= 2 else []
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    return {
        "ours": round(medians["ours"], 4),
        "peer": round(medians["peer"], 4),
        "ratio": round(medians["peer"] / medians["ours"], 3),
        "spread": {name: [round(min(v), 4), round(max(v), 4)] for name, v in seconds.items()},
        "repetitions": repetitions,
    }


if __name__ == "__main__":
    main()
