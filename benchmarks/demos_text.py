"""Fine-tuning on demonstrations: prefrl's `learner.kind=sft` against TRL's SFTTrainer, at equal data, order and steps.

    python benchmarks/demos_text.py [--texts 300] [--seed 100] [--short]

Good reviews, as `text/reviews-demos` has them, are learned from the same weights by both: the same tokens, minibatches
of 16 in the same order, four passes, Adam with the same rate, eps and bound of the gradient, float32, no dropout. What
comes of it is measured by one piece of code: the mean of -log pi over the tokens of 200 good reviews not learned.
TRL has an environment of its own (`make .venv-peers-text/ready`). The last line is one JSON object: `ratio` is ours /
peer, and `seconds` are CPU seconds of learning, of one process after the other.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

MINIBATCH, EPOCHS, RATE, HELD_OUT = 16, 4, 1e-4, 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--texts", type=int, default=300, help="how many are learned")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--short", action="store_true", help="48 texts")
    parser.add_argument("--peers", default=".venv-peers-text/bin/python", help="Python of the environment with TRL")
    parser.add_argument("--peer", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.peer:
        peer(options.peer)
    elif not Path(options.peers).exists():
        sys.exit(f"no {options.peers}: run `make .venv-peers-text/ready`, or say --peers")
    else:
        with TemporaryDirectory() as folder:
            print(json.dumps(compare(Path(folder), options) | {"short": options.short}))


def compare(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Ours learns first, and leaves weights, tokens and their order to the other side."""
    import numpy as np
    import torch
    from safetensors.torch import load_file

    from prefrl.config import Config
    from prefrl.improve.direct import Direct
    from prefrl.improve.pairs import shuffled
    from prefrl.improve.sft import supervised
    from prefrl.label.author import drafts
    from prefrl.policies.responses import Responses

    torch.set_num_threads(1)
    config = Config.load("text/reviews-demos", [f"learner.minibatch={MINIBATCH}", f"learner.learning_rate={RATE}"])
    task: Any = config.build_task()
    count, rng = 48 if options.short else options.texts, np.random.default_rng(options.seed)
    found = drafts(task, count + HELD_OUT, 8, rng)
    learned, held_out = (Responses.of(some, task) for some in (found[:count], found[count:]))
    order = [at for _ in range(EPOCHS) for at in shuffled(count, MINIBATCH, rng)]
    learner: Any = config.build_learner(task, rng)
    assert isinstance(learner, Direct)

    def loss() -> float:
        with torch.no_grad():
            return float(-learner.policy.log_prob(held_out)[0].sum() / held_out.mask.sum())

    before = loss()
    leave(folder, task, learned, order)
    begin = time.process_time()
    for _ in supervised(learner._writer, config.learner, learned, order):  # type: ignore[arg-type]
        pass
    spent, ours = time.process_time() - begin, loss()
    subprocess.run([options.peers, __file__, "--peer", str(folder)], check=True, stdout=subprocess.DEVNULL)
    learner.policy.model.load_state_dict(load_file(folder / "after" / "model.safetensors"), strict=False)
    theirs, said = loss(), json.loads((folder / "said.json").read_text())
    return {
        "name": f"demos_text: {count} good reviews, {len(order)} steps",
        "unit": "nats a token of held-out reviews",
        "before": round(before, 4),
        "ours": round(ours, 4),
        "peer": round(theirs, 4),
        "ratio": round(ours / theirs, 5),
        "seconds": [round(spent, 1), round(said["seconds"], 1)],
        "steps": [len(order), said["steps"]],
        "equal_work": len(order) == said["steps"],
    }


def leave(folder: Path, task: Any, rows: Any, order: Any) -> None:
    """The weights, and each minibatch's rows: the tokens of prompt and response, and which are to be learned."""
    task.model().save_pretrained(folder / "start")
    task.tokenizer.save_pretrained(folder / "start")
    special = {name: str(token) for name, token in task.tokenizer.special_tokens_map.items()}
    (folder / "special.json").write_text(json.dumps(special))
    tokens = [row[mask].tolist() for row, mask in zip(rows.tokens, rows.mask, strict=True)]
    batches = [[[list(rows.prompt_tokens[i]), tokens[i]] for i in at] for at in order]
    (folder / "batches.json").write_text(json.dumps(batches))


def peers_settings(folder: Path, steps: int) -> Any:
    """Those of `clone`, by TRL's names."""
    import torch
    from trl import SFTConfig

    return SFTConfig(
        output_dir=str(folder / "peer"),
        per_device_train_batch_size=MINIBATCH,
        max_steps=steps,
        learning_rate=RATE,
        lr_scheduler_type="constant",
        optim="adamw_torch",
        adam_epsilon=1e-5,
        weight_decay=0.0,
        max_grad_norm=1.0,
        completion_only_loss=True,
        bf16=False,
        use_cpu=True,
        gradient_checkpointing=False,
        max_length=None,
        save_strategy="no",
        logging_strategy="no",
        report_to="none",
        disable_tqdm=True,
        model_init_kwargs={"dtype": torch.float32},
        dataset_kwargs={"skip_prepare_dataset": True},
        remove_unused_columns=False,
    )


def peer(folder: Path) -> None:
    """TRL's side, in its own environment."""
    import torch
    from datasets import Dataset
    from transformers import PreTrainedTokenizerFast, TrainerCallback
    from trl import SFTTrainer

    torch.set_num_threads(1)
    batches = json.loads((folder / "batches.json").read_text())
    rows = [row for batch in batches for row in batch]
    columns = {
        "input_ids": [prompt + told for prompt, told in rows],
        "labels": [[-100] * len(prompt) + told for prompt, told in rows],
    }
    ends = [sum(len(batch) for batch in batches[: i + 1]) for i in range(len(batches))]
    planned = [list(range(end - len(batch), end)) for end, batch in zip(ends, batches, strict=True)]

    class InOrder(SFTTrainer):  # type: ignore[misc]
        """The rows of each minibatch as they were given."""

        def get_train_dataloader(self) -> Any:
            planner: Any = planned
            return torch.utils.data.DataLoader(self.train_dataset, batch_sampler=planner, collate_fn=self.data_collator)

    clock: dict[str, float] = {}

    class Clock(TrainerCallback):  # type: ignore[misc]
        def on_train_begin(self, *_: Any, **__: Any) -> None:
            clock["begin"] = time.process_time()

    file = str(folder / "start" / "tokenizer.json")  # its settings are of another version of transformers
    special = json.loads((folder / "special.json").read_text())
    tokenizer = PreTrainedTokenizerFast(tokenizer_file=file, **special)
    trainer = InOrder(
        str(folder / "start"),
        peers_settings(folder, len(batches)),
        train_dataset=Dataset.from_dict(columns),
        processing_class=tokenizer,
        callbacks=[Clock()],
    )
    trainer.train()
    spent = time.process_time() - clock["begin"]
    trainer.model.save_pretrained(folder / "after", safe_serialization=True)
    (folder / "said.json").write_text(json.dumps({"seconds": spent, "steps": trainer.state.global_step}))


if __name__ == "__main__":
    main()
