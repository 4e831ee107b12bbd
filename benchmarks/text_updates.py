"""One update of a language model on both sides, in turns: what text_rloo, text_ppo, text_ragged and text_lora share.

prefrl's text learner against TRL's trainers, from the same weights and prompts, one Adam step (of PPO one an epoch), KL
to a reference, no dropout, no gradient checkpointing, one thread each. CPU seconds of an update are compared by their
medians.
"""

from __future__ import annotations

import argparse
import copy
import json
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from turns import ask, start, wait

BETA = 0.05


@dataclass(frozen=True)
class Update:
    """The work that both sides do."""

    folder: str
    """With a model, its tokenizer, and `prompts.json`, a list of prompts."""
    prompts: int
    samples: int
    """Responses to each prompt."""
    new_tokens: int
    """The most tokens of a response."""
    fixed: bool = True
    """Whether responses have exactly so many tokens, or end where they end."""
    algorithm: Literal["rloo", "grpo", "ppo"] = "rloo"
    critic: Literal["shared", "own"] = "shared"
    """Of PPO: whose hidden states it reads."""
    epochs: int = 1
    lora_rank: int = 0
    """0 to train everything."""
    chunk: int = 64
    """Responses in a pass of prefrl's."""
    learning_rate: float = 1e-4

    def rounds(self) -> Iterator[list[str]]:
        """The prompts of one update after another, the same for both sides."""
        known = json.loads((Path(self.folder) / "prompts.json").read_text())
        at = 0
        while True:
            yield [known[(at + i) % len(known)] for i in range(self.prompts)]
            at += self.prompts


def options_of(description: str | None, peers: str = ".venv-peers-text") -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="fewer repetitions: under two minutes")
    parser.add_argument("--peers", default=f"{peers}/bin/python", help="Python of the environment that holds TRL")
    return parser


def reward_of(tokens: list[int]) -> float:
    """A reward that costs nothing: the share of even tokens."""
    return sum(token % 2 == 0 for token in tokens) / len(tokens)


def compare(work: Update, peers: str, repetitions: int) -> dict[str, Any]:
    """Let both sides make an update in turn; the first two are for warming up.

    Where responses end where they end, the sides draw others: then seconds are those of 1000 tokens.
    """
    if not Path(peers).exists():
        sys.exit(f"no {peers}: run `make peers`, or install benchmarks/peers-*.txt and say --peers")
    said = json.dumps(asdict(work))
    workers = {
        name: start([python, __file__, name, said]) for name, python in {"ours": sys.executable, "peer": peers}.items()
    }
    seconds: dict[str, list[float]] = {"ours": [], "peer": []}
    found: dict[str, Any] = {}
    for i in range(repetitions + 2):
        for name in ("ours", "peer") if i % 2 else ("peer", "ours"):
            found[name] = ask(workers[name])
            if work.fixed and found[name]["tokens"] != work.prompts * work.samples * work.new_tokens:
                raise RuntimeError(f"{name} generated {found[name]['tokens']} tokens: the work is not equal")
            scale = 1.0 if work.fixed else 1000 / found[name]["tokens"]
            seconds[name] += [found[name]["seconds"] * scale] if i >= 2 else []
    for worker in workers.values():
        worker.kill()
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    spread = {name: [round(min(values), 4), round(max(values), 4)] for name, values in seconds.items()}
    return {
        "unit": "CPU s" if work.fixed else "CPU s for 1000 tokens",
        "ours": round(medians["ours"], 4),
        "peer": round(medians["peer"], 4),
        "ratio": round(medians["peer"] / medians["ours"], 3),
        "spread": spread,
        "equal_work": True,
        "repetitions": repetitions,
        "peak_gb": {name: round(found[name]["peak_gb"], 2) for name in found},
    }


def tell(begin: float, tokens: int) -> None:
    used = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print("RESULT " + json.dumps({"seconds": used, "tokens": tokens, "peak_gb": peak}), flush=True)


def ours(work: Update) -> None:
    import numpy as np
    import torch
    from transformers import AutoModelForCausalLM, PreTrainedTokenizerFast

    from prefrl.improve.text import TextLearnerSettings
    from prefrl.policies.pretrained import on_same_weights

    torch.set_num_threads(1)
    words = PreTrainedTokenizerFast.from_pretrained(work.folder)
    rounds, begun = work.rounds(), AutoModelForCausalLM.from_pretrained(work.folder, dtype=torch.float32).eval()
    task: Any = SimpleNamespace(
        kind="text",
        tokenizer=words,
        encode=lambda prompt: tuple(words.encode(prompt)),
        ends=() if work.fixed else (words.eos_token_id,),
        response_tokens=work.new_tokens,
        model=lambda frozen=False: on_same_weights(begun) if frozen else copy.deepcopy(begun),
        prompts=lambda count, rng: next(rounds),
    )
    reward: Any = SimpleNamespace(score=lambda found: np.array([reward_of(list(r.tokens)) for r in found], np.float32))
    sizes = {"updates": 1, "prompts": work.prompts, "responses": work.samples}
    steps = {"beta": BETA, "learning_rate": work.learning_rate, "missing_end_penalty": 0.0, "epochs": work.epochs}
    if work.algorithm == "ppo":
        steps["critic"] = {"network": work.critic, "trace": 0.95, "clip": 0.2}
    adapters = {"train": "lora", "lora_rank": work.lora_rank} if work.lora_rank else {}
    policy = {"chunk": work.chunk, **adapters}
    settings = TextLearnerSettings.model_validate({"algorithm": work.algorithm, **sizes, **steps, "policy": policy})
    store: Any = None
    learner, rng = settings.build(task, np.random.default_rng(0)), np.random.default_rng(1)
    while True:
        before, begin = learner.steps.learn, wait()
        learner.improve(reward, store, rng)
        tell(begin, learner.steps.learn - before)


def peer(work: Update) -> None:
    if work.algorithm == "ppo":
        peer_ppo(work)
        return
    import torch
    from datasets import Dataset
    from peft import LoraConfig
    from transformers import PreTrainedTokenizerFast
    from trl import GRPOConfig, GRPOTrainer, RLOOConfig, RLOOTrainer

    torch.set_num_threads(1)
    tokenizer = PreTrainedTokenizerFast.from_pretrained(work.folder, padding_side="left")
    counts: list[int] = []

    def score(completion_ids: list[list[int]], **_: Any) -> list[float]:
        counts.append(sum(map(len, completion_ids)))
        return [reward_of(tokens) for tokens in completion_ids]

    settings, trainer = {"rloo": (RLOOConfig, RLOOTrainer), "grpo": (GRPOConfig, GRPOTrainer)}[work.algorithm]
    config = settings(
        output_dir=str(Path(work.folder) / "peer"),
        per_device_train_batch_size=work.prompts * work.samples,
        num_generations=work.samples,
        max_completion_length=work.new_tokens,
        generation_kwargs={"min_new_tokens": work.new_tokens} if work.fixed else {},
        steps_per_generation=1,
        num_iterations=1,
        beta=BETA,
        learning_rate=work.learning_rate,
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
    rounds = work.rounds()
    data = Dataset.from_dict({"prompt": [prompt for _ in range(50) for prompt in next(rounds)]})
    adapters = LoraConfig(
        r=work.lora_rank or 1, lora_alpha=2 * work.lora_rank, target_modules="all-linear", task_type="CAUSAL_LM"
    )
    trainer(
        work.folder,
        score,
        config,
        data,
        processing_class=tokenizer,
        callbacks=[turns(lambda: counts[-1])],
        peft_config=adapters if work.lora_rank else None,
    ).train()


def peer_ppo(work: Update) -> None:
    """The last PPO of TRL. Its critic is always a model by itself; one that shares has the policy's trunk in it."""
    import torch
    from datasets import Dataset
    from transformers import AutoModelForCausalLM, AutoModelForSequenceClassification, PreTrainedTokenizerFast
    from trl.experimental.ppo import PPOConfig, PPOTrainer

    torch.set_num_threads(1)
    tokenizer = PreTrainedTokenizerFast.from_pretrained(work.folder, padding_side="left")
    count = work.prompts * work.samples
    config = PPOConfig(
        output_dir=str(Path(work.folder) / "peer"),
        per_device_train_batch_size=count,
        local_rollout_forward_batch_size=work.chunk,
        num_mini_batches=1,
        num_ppo_epochs=work.epochs,
        response_length=work.new_tokens,
        stop_token=None,
        kl_coef=BETA,
        learning_rate=work.learning_rate,
        lr_scheduler_type="constant",
        num_sample_generations=0,
        total_episodes=10**6,
        bf16=False,
        use_cpu=True,
        gradient_checkpointing=False,
        save_strategy="no",
        logging_strategy="no",
        report_to="none",
        disable_tqdm=True,
    )
    rounds = work.rounds()
    data = Dataset.from_dict({"input_ids": [tokenizer.encode(p) for _ in range(50) for p in next(rounds)]})
    policy, reference = (AutoModelForCausalLM.from_pretrained(work.folder, dtype=torch.float32) for _ in range(2))
    critic = AutoModelForSequenceClassification.from_pretrained(work.folder, num_labels=1, dtype=torch.float32)
    if work.critic == "shared":
        critic.model = policy.model
    PPOTrainer(
        args=config,
        processing_class=tokenizer,
        model=policy,
        ref_model=reference,
        reward_model=free_reward(),
        train_dataset=data,
        eval_dataset=data,
        value_model=critic,
        callbacks=[turns(lambda: count * work.new_tokens)],
    ).train()


def free_reward() -> Any:
    """`reward_of` as the model that TRL's PPO wants."""
    import torch

    class Trunk(torch.nn.Module):
        def forward(self, input_ids: Any, **_: Any) -> SimpleNamespace:
            return SimpleNamespace(
                hidden_states=[(input_ids % 2 == 0).float().mean(1, keepdim=True).expand_as(input_ids)]
            )

    class Reward(torch.nn.Module):
        base_model_prefix = "trunk"

        def __init__(self) -> None:
            super().__init__()
            self.trunk = Trunk()

        def score(self, states: Any) -> Any:
            return states[..., None]

    return Reward()


def turns(tokens: Callable[[], int]) -> Any:
    """Makes a trainer of transformers wait before each step until it is asked for, and tell what it took."""
    from transformers import TrainerCallback

    class Turns(TrainerCallback):
        begin = 0.0

        def on_train_begin(self, *_: Any, **__: Any) -> None:
            self.begin = wait()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            tell(self.begin, tokens())
            self.begin = wait()

    return Turns()


if __name__ == "__main__":
    {"ours": ours, "peer": peer}[sys.argv[1]](Update(**json.loads(sys.argv[2])))
