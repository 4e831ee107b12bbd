"""The stages on their own: collect labels, fit a reward model, improve a policy, evaluate one."""

from prefrl.stages.labels import Tell, attended, label, read_queries, serve, with_gold
from prefrl.stages.policies import evaluate, export_onnx, export_sb3, load_policy, on_stage, shown_of
from prefrl.stages.rewards import (
    config_of,
    export_classifier,
    fit_reward,
    report_card,
    reward_of,
    with_reward,
    write_card,
)
from prefrl.stages.texts import Drawn, answered, generate, generate_best, policy_of, prompts_for
from prefrl.stages.trial import estimate, shrink

__all__ = [
    "Drawn",
    "Tell",
    "answered",
    "attended",
    "config_of",
    "estimate",
    "evaluate",
    "export_classifier",
    "export_onnx",
    "export_sb3",
    "fit_reward",
    "generate",
    "generate_best",
    "label",
    "load_policy",
    "on_stage",
    "policy_of",
    "prompts_for",
    "read_queries",
    "report_card",
    "reward_of",
    "serve",
    "shown_of",
    "shrink",
    "with_gold",
    "with_reward",
    "write_card",
]
