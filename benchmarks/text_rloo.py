"""One RLOO or GRPO update of a Llama: prefrl's text learner against TRL's trainers, at equal work.

    python benchmarks/text_rloo.py [--size 1m|13m] [--algorithm rloo|grpo] [--short] [--peers PYTHON]

Both start from the same weights and prompts: 16 prompts x 4 responses of 48 tokens, KL to a reference at 0.05, one
Adam step, float32, no dropout, no gradient checkpointing, one thread each. The two processes take turns, an update
each; CPU seconds of an update are compared by their medians. `ratio` is peer / ours: above 1, prefrl needs fewer.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

PROMPTS, SAMPLES, NEW_TOKENS, WORDS, PROMPT_TOKENS = 16, 4, 48, 2048, 8
SIZES = {"1m": (4, 128, 4, 2048), "13m": (6, 384, 6, 8192)}
"""Layers, width, heads, vocabulary."""
BETA, LEARNING_RATE = 0.05, 1e-4
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=SIZES, default="1m")
    parser.add_argument("--algorithm", choices=("rloo", "grpo"), default="rloo")
    parser.add_argument("--short", action="store_true", help="fewer repetitions: 1m in under two minutes")
    parser.add_argument(
        "--peers", default=".venv-peers-text/bin/python", help="Python of the environment that holds TRL"
    )
    parser.add_argument("--worker", choices=["ours", "peer"], help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        {"ours": ours, "peer": peer}[options.worker](Path(options.folder), options.algorithm)
        return
    if not Path(options.peers).exists():
        sys.exit(f"no {options.peers}: run `make peers`, or install benchmarks/peers-text.txt and say --peers")
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder), options.size)
        found = compare(Path(folder), options.peers, options.algorithm, 5 if options.short else 20)
    work = f"one {options.algorithm.upper()} update, {options.size}, {PROMPTS * SAMPLES} x {NEW_TOKENS} tokens, fp32"
    print(json.dumps({"name": f"text_rloo: {work}"} | found | {"short": options.short}))


def make_model(folder: Path, size: str) -> None:
    """Random weights and a tokenizer of whole words, t0 ... t2047, for both sides to read."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import LlamaConfig, LlamaForCausalLM

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
    LlamaForCausalLM(config).save_pretrained(folder)
    words = Tokenizer(models.WordLevel({f"t{i}": i for i in range(WORDS)}, unk_token="t3"))
    words.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    words.save(str(folder / "words.json"))


def prompts(round: int) -> list[str]:
    """The same 16 prompts for both sides."""
    return [
        " ".join(f"t{10 + (997 * round + 31 * i + 7 * j) % (WORDS - 10)}" for j in range(PROMPT_TOKENS))
        for i in range(PROMPTS)
    ]


def reward_of(tokens: list[int]) -> float:
    """A reward that costs nothing: the share of even tokens."""
    return sum(token % 2 == 0 for token in tokens) / len(tokens)


def compare(folder: Path, peers: str, algorithm: str, repetitions: int) -> dict[str, Any]:
    """Let both sides make an update in turn; the first two are for warming up."""
    sides = {"ours": sys.executable, "peer": peers}
    workers = {name: start(name, python, folder, algorithm) for name, python in sides.items()}
    seconds: dict[str, list[float]] = {"ours": [], "peer": []}
    for i in range(repetitions + 2):
        for name in ("ours", "peer") if i % 2 else ("peer", "ours"):
            found = ask(workers[name])
            if found["tokens"] != PROMPTS * SAMPLES * NEW_TOKENS:
                raise RuntimeError(f"{name} generated {found['tokens']} tokens: the work is not equal")
            seconds[name] += [found["seconds"]] if i >= 2 else []
    for worker in workers.values():
        worker.kill()
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    spread = {name: [round(min(values), 4), round(max(values), 4)] for name, values in seconds.items()}
    return {
        "unit": "CPU s",
        "ours": round(medians["ours"], 4),
        "peer": round(medians["peer"], 4),
        "ratio": round(medians["peer"] / medians["ours"], 3),
        "spread": spread,
        "equal_work": True,
        "repetitions": repetitions,
    }


def start(name: str, python: str, folder: Path, algorithm: str) -> subprocess.Popen[str]:
    command = [python, __file__, "--worker", name, "--folder", str(folder), "--algorithm", algorithm]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **ONE_THREAD}
    )


def ask(worker: subprocess.Popen[str]) -> dict[str, Any]:
    """Have one update made; other lines that a library prints are passed over."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write("go\n")
    worker.stdin.flush()
    for line in worker.stdout:
        if line.startswith("RESULT "):
            found: dict[str, Any] = json.loads(line[7:])
            return found
    raise RuntimeError(f"{worker.args!r} ended early")


def wait() -> float:
    """Wait for our turn; the time at which it begins."""
    if not sys.stdin.readline():
        sys.exit()
    return time.process_time()


def tell(begin: float, tokens: int) -> None:
    print("RESULT " + json.dumps({"seconds": time.process_time() - begin, "tokens": tokens}), flush=True)


def ours(folder: Path, algorithm: str) -> None:
    import numpy as np
    import torch
    from transformers import LlamaForCausalLM, PreTrainedTokenizerFast

    from prefrl.improve.text import TextLearnerSettings

    torch.set_num_threads(1)
    words = PreTrainedTokenizerFast(tokenizer_file=str(folder / "words.json"))
    rounds = iter(range(10**6))
    task: Any = SimpleNamespace(
        kind="text",
        tokenizer=words,
        encode=lambda prompt: tuple(words.encode(prompt)),
        ends=(),  # a fixed length
        response_tokens=NEW_TOKENS,
        model=lambda frozen=False: LlamaForCausalLM.from_pretrained(folder, dtype=torch.float32).eval(),
        prompts=lambda count, rng: prompts(next(rounds)),
    )
    reward: Any = SimpleNamespace(score=lambda found: np.array([reward_of(list(r.tokens)) for r in found], np.float32))
    sizes = {"updates": 1, "prompts": PROMPTS, "responses": SAMPLES}
    steps = {"beta": BETA, "learning_rate": LEARNING_RATE, "missing_end_penalty": 0.0}
    settings = TextLearnerSettings.model_validate({"algorithm": algorithm, **sizes, **steps})
    store: Any = None
    learner, rng = settings.build(task, np.random.default_rng(0)), np.random.default_rng(1)
    while True:
        before, begin = learner.steps.learn, wait()
        learner.improve(reward, store, rng)
        tell(begin, learner.steps.learn - before)


def peer(folder: Path, algorithm: str) -> None:
    import torch
    from datasets import Dataset
    from transformers import PreTrainedTokenizerFast, TrainerCallback
    from trl import GRPOConfig, GRPOTrainer, RLOOConfig, RLOOTrainer

    torch.set_num_threads(1)
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_file=str(folder / "words.json"), pad_token="t0", bos_token="t1", eos_token="t2", padding_side="left"
    )
    counts: list[int] = []

    def score(completion_ids: list[list[int]], **_: Any) -> list[float]:
        counts.append(sum(map(len, completion_ids)))
        return [reward_of(tokens) for tokens in completion_ids]

    class Turns(TrainerCallback):
        begin = 0.0

        def on_train_begin(self, *_: Any, **__: Any) -> None:
            self.begin = wait()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            tell(self.begin, counts[-1])
            self.begin = wait()

    settings, trainer = {"rloo": (RLOOConfig, RLOOTrainer), "grpo": (GRPOConfig, GRPOTrainer)}[algorithm]
    config = settings(
        output_dir=str(folder / "peer"),
        per_device_train_batch_size=PROMPTS * SAMPLES,
        num_generations=SAMPLES,
        max_completion_length=NEW_TOKENS,
        generation_kwargs={"min_new_tokens": NEW_TOKENS},
        steps_per_generation=1,
        num_iterations=1,
        beta=BETA,
        learning_rate=LEARNING_RATE,
        lr_scheduler_type="constant",
        max_grad_norm=1.0,
        temperature=1.0,
        top_p=1.0,
        top_k=0,
        max_steps=10**6,
        bf16=False,
        use_cpu=True,
        gradient_checkpointing=False,
        disable_dropout=True,
        save_strategy="no",
        logging_strategy="no",
        report_to="none",
        disable_tqdm=True,
        model_init_kwargs={"dtype": torch.float32},
    )
    data = Dataset.from_dict({"prompt": [p for i in range(50) for p in prompts(i)]})
    trainer(str(folder), score, config, data, processing_class=tokenizer, callbacks=[Turns()]).train()


if __name__ == "__main__":
    main()
