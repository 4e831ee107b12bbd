"""The objectives of policy gradients for text, in plain letters."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prefrl.improve.text import TextLearnerSettings

NETWORKS = {"shared": "the policy's hidden states", "own": "a network of its own"}
AVERAGES = {"constant": "mean_i sum_t", "token": "mean over all tokens", "sequence": "mean_i mean_t"}
ADVANTAGES = {
    "leave_one_out": "R_i - mean of the prompt's other R_j",
    "group_normalised": "(R_i - mean of the prompt's R_j) / (their std + 1e-4)",
    "batch_scaled": "(R_i - mean of the prompt's R_j) / (std of the batch's R + 1e-4)",
    "batch_mean": "R_i - mean of the batch's R_j",
}
"""Of a response."""


def text_formula(settings: TextLearnerSettings) -> str:
    """The objective in plain letters, with the settings' numbers."""
    index = "A_t" if settings.advantage == "gae" else "A_i"
    gain = f"log pi(y_t) {index}"
    if settings.clip is not None:
        gain = f"min(r {index}, clip(r, {1 - settings.clip:g}, {1 + settings.clip:g}) {index})"
    lines = [
        f"maximise  {AVERAGES[settings.reduction]} [ {gain} ]",
        *(["r = pi(y_t) / pi_old(y_t)"] if settings.clip is not None else []),
        *([_moves(settings)] if settings.reference_every and settings.beta else []),
        *(_by_token(settings) if settings.advantage == "gae" else _by_response(settings)),
        f"{settings.prompts} prompts x {settings.responses} responses a batch, "
        f"{settings.epochs * settings.minibatches} gradient step(s) on each; temperature {settings.temperature:g}",
    ]
    return "\n".join(lines)


def _by_response(settings: TextLearnerSettings) -> list[str]:
    apart = "sum_t [log pi_old(y_t) - log ref(y_t)]"
    others = "the batch's" if settings.advantage == "batch_mean" else "the prompt's other"
    beside = f" - {_beta(settings)} (K_i - mean of {others} K_j),  K_i = {apart}"
    after = beside if settings.beta and settings.kl_in == "advantage" else ""
    in_reward = f" - {_beta(settings)} {apart}" if settings.beta and not after else ""
    return [f"A_i = {ADVANTAGES[settings.advantage]}{after}", f"R_i = {_score(settings)}{in_reward}"]


def _by_token(settings: TextLearnerSettings) -> list[str]:
    """With a critic: the score comes with a response's last token, T."""
    how = settings.critic
    kl = f" - {_beta(settings)} [log pi_old(y_t) - log ref(y_t)]" if settings.beta else ""
    clip = "" if how.clip is None else f", V within {how.clip:g} of V_old"
    return [
        f"A_t = sum_k {how.trace:g}^k [R_(t+k) + V_old(t+k+1) - V_old(t+k)]" + (", whitened" if how.whiten else ""),
        f"R_t = [t = T] {_score(settings)}{kl}",
        f"minus {how.weight:g} mean_t [ (V(t) - A_t - V_old(t))^2 / 2 ]{clip};  V from {NETWORKS[how.network]}",
    ]


def _beta(settings: TextLearnerSettings) -> str:
    return f"{settings.beta:g}" + (f" (steered to {settings.kl_target:g} nats)" if settings.kl_target else "")


def _moves(settings: TextLearnerSettings) -> str:
    mix = settings.reference_mix
    return f"ref <- {1 - mix:.2g} ref + {mix:g} pi after each {settings.reference_every} updates"


def _score(settings: TextLearnerSettings) -> str:
    """What is learned from of a response's score."""
    score = "score(y_i)" if settings.reward_clip is None else f"clip(score(y_i), +-{settings.reward_clip:g})"
    cost = f" - {settings.length_cost:g} tokens(y_i)" if settings.length_cost else ""
    end = "" if settings.drop_unended else f" - {settings.missing_end_penalty:g} [no end token]"
    return score + end + cost + (", of responses with an end token alone" if settings.drop_unended else "")
