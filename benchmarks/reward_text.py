"""Fitting a 13M-parameter reward model of text: prefrl's fit against TRL's RewardTrainer, at equal work.

    python benchmarks/reward_text.py [--short] [--peers .venv-peers-text/bin/python]

Both start from one classifier checkpoint (a Llama of 6 layers, width 384, vocabulary 8,192) and see the same pairs
once: 32 pairs a gradient step, two responses of 40-88 tokens to each prompt, the prompt's 16 among them. AdamW, no
dropout, no gradient checkpointing, one thread each. The two processes take turns, a gradient step each; tokens are
those of both sides without padding, and seconds are CPU seconds, by their medians. What one side does before its
first step and after its last is not counted in the steps; `fit_seconds` is ours, all of it. Both precisions are
measured; where the CPU has no fast bfloat16 products, neither side gains by it. `ratio` is ours / peer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from turns import ask, start, wait

PAIRS, LEAST, MOST, PROMPT, VOCABULARY, HELD_OUT = 32, 40, 88, 16, 8192, 128
GOOD, BAD = range(10, 138), range(138, 266)
"""The planted rule: the response with the larger share of good words is the better one."""
LEARNING_RATE = 5e-4
WARM_UP = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="fewer steps: under two minutes, too few to learn")
    parser.add_argument(
        "--peers", default=".venv-peers-text/bin/python", help="Python of the environment that holds TRL"
    )
    parser.add_argument("--worker", choices=["ours", "peer"], help=argparse.SUPPRESS)
    parser.add_argument("--precision", choices=["float32", "bfloat16"], help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        {"ours": ours, "peer": peer}[options.worker](Path(options.folder), options.precision)
        return
    if not Path(options.peers).exists():
        sys.exit(f"no {options.peers}: run `make peers`, or install benchmarks/peers-text.txt and say --peers")
    steps = 4 if options.short else 40
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder))
        make_pairs(Path(folder), steps * PAIRS)
        found = {p: compare(Path(folder), options.peers, steps, p) for p in ("float32", "bfloat16")}
    name = "reward_text: tokens a second in fitting a 13M-parameter reward model"
    print(json.dumps({"name": name, **found["float32"], "bfloat16": found["bfloat16"], "short": options.short}))


def make_model(folder: Path) -> None:
    """A classifier with random weights, and a tokenizer of whole words, t0 ... t8191, for both sides to read."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import LlamaConfig, LlamaForSequenceClassification, PreTrainedTokenizerFast

    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=VOCABULARY,
        hidden_size=384,
        intermediate_size=1024,
        num_hidden_layers=6,
        num_attention_heads=6,
        max_position_embeddings=256,
        pad_token_id=0,
        bos_token_id=1,
        eos_token_id=2,
        num_labels=1,
    )
    LlamaForSequenceClassification(config).save_pretrained(folder)
    words = Tokenizer(models.WordLevel({f"t{i}": i for i in range(VOCABULARY)}, unk_token="t3"))
    words.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="t0", bos_token="t1", eos_token="t2")
    tokenizer.save_pretrained(folder)


def make_pairs(folder: Path, count: int) -> None:
    """Rows of prompt, better and worse tokens; the last `HELD_OUT` are for testing."""
    import numpy as np

    rng, rows = np.random.default_rng(0), []
    for _ in range(count + HELD_OUT):
        pair = sorted((response(rng) for _ in range(2)), key=share, reverse=True)
        rows.append([rng.integers(266, VOCABULARY, PROMPT).tolist(), *pair])
    (folder / "pairs.json").write_text(json.dumps(rows))


def response(rng: Any) -> list[int]:
    count = int(rng.integers(LEAST, MOST + 1)) - PROMPT - 1
    good = rng.random(count) < rng.random()
    words = rng.integers(0, len(GOOD), count)
    return [*(int(w) + (GOOD if g else BAD).start for w, g in zip(words, good, strict=True)), 2]


def share(tokens: list[int]) -> float:
    return sum(t in GOOD for t in tokens) / len(tokens)


def read_pairs(folder: Path) -> tuple[list[Any], list[Any]]:
    """Training rows and held-out rows."""
    rows = json.loads((folder / "pairs.json").read_text())
    return rows[:-HELD_OUT], rows[-HELD_OUT:]


def compare(folder: Path, peers: str, steps: int, precision: str) -> dict[str, Any]:
    """Let both sides make a gradient step in turn; the first two are for warming up."""
    workers = {
        name: start([python, __file__, "--worker", name, "--folder", str(folder), "--precision", precision])
        for name, python in (("ours", sys.executable), ("peer", peers))
    }
    seconds: dict[str, list[float]] = {"ours": [], "peer": []}
    for i in range(steps):
        for name in ("ours", "peer") if i % 2 else ("peer", "ours"):
            seconds[name].append(ask(workers[name])["seconds"])
    ends = {name: ask(worker) for name, worker in workers.items()}
    for worker in workers.values():
        worker.kill()
    train, _ = read_pairs(folder)
    tokens = sum(2 * len(prompt) + len(better) + len(worse) for prompt, better, worse in train) / steps
    rates = {name: [tokens / s for s in values[WARM_UP:]] for name, values in seconds.items()}
    medians = {name: statistics.median(values) for name, values in rates.items()}
    return {
        "unit": "tokens / CPU s",
        "ours": round(medians["ours"], 1),
        "peer": round(medians["peer"], 1),
        "ratio": round(medians["ours"] / medians["peer"], 3),
        "spread": {name: [round(min(values), 1), round(max(values), 1)] for name, values in rates.items()},
        "equal_work": True,
        "accuracy": {name: end["accuracy"] for name, end in ends.items()},
        "fit_seconds": round(sum(seconds["ours"]) + ends["ours"]["seconds"], 2),
        "peer_seconds": round(sum(seconds["peer"]) + ends["peer"]["seconds"], 2),
        "steps": steps,
    }


class Turns:
    """Wait for our turn, and say what it took when it is over."""

    def __init__(self) -> None:
        self.begin = 0.0

    def wait(self) -> None:
        self.begin = wait()

    def tell(self, **more: float) -> None:
        print("RESULT " + json.dumps({"seconds": time.process_time() - self.begin, **more}), flush=True)

    def over(self, *_: Any) -> None:
        self.tell()
        self.wait()

    def after(self, step: Callable[[Any], None]) -> Callable[[Any], None]:
        def stepped(optimizer: Any) -> None:
            step(optimizer)
            self.over()

        return stepped


def ours(folder: Path, precision: Any) -> None:
    import numpy as np
    import torch
    from transformers import AutoTokenizer

    from prefrl.fit.adam import Adam
    from prefrl.fit.settings import FittingSettings
    from prefrl.fit.trainer import fit
    from prefrl.judgements import Comparison
    from prefrl.reward_models.text import TransformerSettings
    from prefrl.store import Store
    from prefrl.types import Query, Response

    torch.set_num_threads(1)
    train, test = ([responses(row, Response) for row in rows] for rows in read_pairs(folder))
    task: Any = SimpleNamespace(kind="text", tokenizer=AutoTokenizer.from_pretrained(folder))
    settings = TransformerSettings(checkpoint=str(folder), members=1, precision=precision)
    reward = settings.build(task, np.random.default_rng(0))
    fitting = FittingSettings(epochs=1, batch_size=PAIRS, learning_rate=LEARNING_RATE, held_out=0.0)
    turns = Turns()
    with Store[Response](folder / precision) as store:
        queries = [(Query(pair), pair[0]) for pair in train]
        store.ask([query for query, _ in queries])
        store.answer([Comparison(query.id, float(query.candidates[0] is better), "rule") for query, better in queries])
        Adam.step = turns.after(Adam.step)  # type: ignore[method-assign]
        turns.wait()
        fit(reward, store, fitting, np.random.default_rng(0))
    spent = time.process_time() - turns.begin
    better, worse = (reward.raw_member_scores([pair[i] for pair in test])[0] for i in range(2))
    turns.begin = time.process_time() - spent
    turns.tell(accuracy=float((better > worse).mean()))


def responses(row: list[Any], kind: Any) -> tuple[Any, Any]:
    """The better and the worse response of a row."""
    prompt, *both = row
    words = " ".join(f"t{t}" for t in prompt)
    found = [kind(words, " ".join(f"t{t}" for t in tokens[:-1]), tuple(prompt), tuple(tokens)) for tokens in both]
    return found[0], found[1]


def peer(folder: Path, precision: str) -> None:
    import torch
    from datasets import Dataset
    from transformers import PreTrainedTokenizerFast, TrainerCallback
    from trl import RewardConfig, RewardTrainer

    torch.set_num_threads(1)
    turns = Turns()

    class Callback(TrainerCallback):
        def on_train_begin(self, *_: Any, **__: Any) -> None:
            turns.wait()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            turns.over()

    config = RewardConfig(
        output_dir=str(folder / "peer"),
        per_device_train_batch_size=PAIRS,
        num_train_epochs=1,
        learning_rate=LEARNING_RATE,
        lr_scheduler_type="constant",
        optim="adamw_torch_fused",
        weight_decay=0.0,
        max_grad_norm=1.0,
        bf16=precision == "bfloat16",
        use_cpu=True,
        gradient_checkpointing=False,
        disable_dropout=True,
        save_strategy="no",
        logging_strategy="no",
        report_to="none",
        disable_tqdm=True,
        model_init_kwargs={"dtype": torch.float32},
    )
    train, test = read_pairs(folder)
    columns = {"chosen_ids": [p + b for p, b, _ in train], "rejected_ids": [p + w for p, _, w in train]}
    file = str(folder / "tokenizer.json")  # its settings are of another version of transformers
    tokenizer = PreTrainedTokenizerFast(tokenizer_file=file, pad_token="t0", bos_token="t1", eos_token="t2")
    data = Dataset.from_dict(columns)
    trainer = RewardTrainer(str(folder), config, train_dataset=data, processing_class=tokenizer, callbacks=[Callback()])
    trainer.train()
    spent = time.process_time() - turns.begin
    right = [logit(trainer.model, p + b) > logit(trainer.model, p + w) for p, b, w in test]
    turns.begin = time.process_time() - spent
    turns.tell(accuracy=sum(right) / len(right))


def logit(model: Any, tokens: list[int]) -> float:
    import torch

    with torch.no_grad():
        return float(model.eval()(input_ids=torch.tensor([tokens])).logits[0, 0])


if __name__ == "__main__":
    main()
