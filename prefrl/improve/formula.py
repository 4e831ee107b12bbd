"""What a text learner optimises, spelled out."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prefrl.improve.text import TextSettings

AVERAGES = {"constant": "mean_i sum_t", "token": "mean over all tokens", "sequence": "mean_i mean_t"}
ADVANTAGES = {
    "leave_one_out": "R_i - mean of the prompt's other R_j",
    "group_normalised": "(R_i - mean of the prompt's R_j) / (their std + 1e-4)",
    "batch_mean": "R_i - mean of the batch's R_j",
}


def text_formula(settings: TextSettings) -> str:
    """The objective in plain letters, with the settings' numbers."""
    gain = "log pi(y_t) A_i"
    if settings.clip is not None:
        gain = f"min(r A_i, clip(r, {1 - settings.clip:g}, {1 + settings.clip:g}) A_i)"
    kl = f"{settings.beta:g}" + (f" (steered to {settings.kl_target:g} nats)" if settings.kl_target else "")
    in_loss = f" - {kl} (log pi(y_t) - log ref(y_t))^2 / 2" if settings.beta and settings.kl_in == "loss" else ""
    in_reward = f" - {kl} sum_t [log pi_old(y_t) - log ref(y_t)]" if settings.beta and not in_loss else ""
    lines = [
        f"maximise  {AVERAGES[settings.reduction]} [ {gain}{in_loss} ]",
        *(["r = pi(y_t) / pi_old(y_t)"] if settings.clip is not None else []),
        f"A_i = {ADVANTAGES[settings.advantage]}",
        f"R_i = score(y_i) - {settings.missing_end_penalty:g} [no end token]{in_reward}",
        f"{settings.prompts} prompts x {settings.responses} responses a batch, "
        f"{settings.epochs * settings.minibatches} gradient step(s) on each; temperature {settings.temperature:g}",
    ]
    return "\n".join(lines)
