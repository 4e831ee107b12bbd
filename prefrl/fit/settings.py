"""How a reward model is fitted."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from prefrl.components import ConfigError, Settings
from prefrl.kinds import named

Ties: TypeAlias = Literal["half", "davidson", "rao_kupper"]
Rankings: TypeAlias = Literal["plackett_luce", "pairs"]
Reliability: TypeAlias = Literal["alike", "learned"]
NO_CROP = "fitting.crop: only segments can be cropped; set it to 0 for text"


class FittingSettings(Settings):
    """How a reward model is fitted. Each fit continues from the last one's weights, on all judgements so far."""

    epochs: int = Field(20, ge=1)
    """The most passes over the training judgements."""
    patience: int = Field(0, ge=0)
    """Stop after so many epochs without a better held-out loss, and go back to the best; 0 runs all epochs."""
    batch_size: int = Field(64, ge=1)
    """Judgements in a gradient step."""
    learning_rate: float = Field(1e-3, gt=0)
    """AdamW's; it starts anew with every fit."""
    weight_decay: Annotated[float, Field(ge=0)] | Literal["adaptive"] = 0.0
    """AdamW's decoupled weight decay; `adaptive` keeps the held-out loss at 1.1 to 1.5 times the training loss."""
    rankings: Rankings = "plackett_luce"
    """How rankings of more than two count: choice after choice, or as all the pairs that they imply."""
    ties: Ties = "half"
    """A tie is half a win for each side, or an outcome of its own whose frequency is learned."""
    error_rate: float = Field(0.0, ge=0, lt=1)
    """The assumed probability that an answer is drawn blindly."""
    reliability: Reliability = "alike"
    """`learned` estimates how often each labeler errs, together with the reward; `error_rate` is then not used."""
    denoise: Literal["off", "filter", "flip"] = "off"
    """Leave out judgements that the model finds improbable, and turn round those it finds all but impossible (RIME)."""
    demonstrations: float = Field(1.0, ge=0)
    """What it counts, beside judgements, that a demonstration is better than what it answers; 0 leaves that out."""
    shown_as: Literal["pairs", "piles"] = "pairs"
    """What a demonstration says: that it is better than what it answers; or, as to a discriminator (GAIL), that it is
    of one pile and what it answers of the other, with a logistic loss of each. Ratings beside it need two levels."""
    newest: int | None = Field(None, ge=1)
    """Fit on so many of the newest judgements alone, and on what so many of the newest demonstrations imply; null for
    all of them. For answers that grow old as the policy changes, as a demonstrator's do."""
    held_out: float = Field(0.15, ge=0, lt=1)
    """The share of judgements that is never trained on, and measures accuracy and calibration."""
    bootstrap: bool = True
    """Give each member of an ensemble its own resampling of the training judgements."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    centre: float = Field(0.0, ge=0)
    """Weight of the squared mean of scores, which a likelihood of preferences leaves free to drift."""
    pseudo_labels: float = Field(0.0, ge=0)
    """Weight of pairs nobody judged, labelled by the model itself where it is sure (SURF)."""
    confidence: float = Field(0.99, gt=0.5, lt=1)
    """How sure it must be."""
    crop: float = Field(0.0, ge=0, lt=1)
    """The most of a segment that is cut away at random in each gradient step (SURF); 0 for none."""

    @model_validator(mode="after")
    def _measured(self) -> Self:
        """What hangs on held-out judgements needs some."""
        if not self.held_out and (self.patience or self.weight_decay == "adaptive"):
            name = "patience" if self.patience else "weight_decay=adaptive"
            raise ValueError(f"{name} needs held-out judgements, and held_out is 0; set held_out=0.15, say")
        return self

    @model_validator(mode="after")
    def _flips(self) -> Self:
        """A label is turned round where it is all but impossible, which nothing is where errors are expected."""
        if self.denoise == "flip" and (self.error_rate > 0 or self.reliability == "learned"):
            raise ValueError(
                "denoise=flip: with error_rate or reliability=learned no label is improbable enough to be turned "
                "round; set error_rate=0 and reliability=alike, or denoise=filter"
            )
        return self


def check_shown(fitting: FittingSettings, shows: bool) -> None:
    """Raise `ConfigError` for a discriminator without anything to tell apart: `shows` says whether there are, or will
    be, demonstrations."""
    if fitting.shown_as == "piles" and not (shows and fitting.demonstrations):
        raise ConfigError(
            "fitting.shown_as=piles tells what was shown from the learner's own, and nothing shown counts: choose a "
            "labeler that shows what to do (labeler.kind=demonstrator) and fitting.demonstrations=1, or set it to pairs"
        )


def check_settings(fitting: FittingSettings, solved: bool, kind: str, candidates: int) -> None:
    """Raise `ConfigError` for what a fit would refuse, before anybody is asked.

    `solved`: the reward model has nothing to descend; `candidates`: how many there are in a query.
    """
    if solved:
        check_solved(fitting)
    if fitting.crop and not named(kind).stepwise:
        raise ConfigError(NO_CROP)
    if fitting.ties == "rao_kupper" and fitting.rankings != "pairs" and candidates > 2:
        raise ConfigError(
            f"fitting.ties=rao_kupper knows pairs only, and select.candidates is {candidates}: set ties=davidson, or "
            "rankings=pairs"
        )


def check_solved(fitting: FittingSettings) -> None:
    """Raise `ConfigError` for settings that change what is fitted from epoch to epoch, or from step to step, or that
    need a score with an offset of its own."""
    off = {"denoise": "off", "pseudo_labels": 0.0, "crop": 0.0, "shown_as": "pairs"}
    if given := [f"fitting.{name}" for name, value in off.items() if getattr(fitting, name) != value]:
        raise ConfigError(
            f"{', '.join(given)}: this reward is solved for, not descended; leave them out, or use another reward.kind"
        )
