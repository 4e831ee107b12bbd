"""What a report card of a reward model says, and what it says of a run's rounds: plain data, as it lies in `card.json`,
`hindsight.json`, `shift.json` and `exact.json`. What is not defined says why."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field, ValidationError, model_validator

from prefrl.stats.estimates import Estimate, Number, Part, Words

P = TypeVar("P", bound=Part)
Points = Annotated[list[Number], Field(max_length=1000)]


class Bucket(Part):
    """Comparisons whose margin lies in a range."""

    low: Number
    high: Number
    accuracy: Estimate
    longer: Estimate | None = None
    """How often the longer one was preferred, where lengths were looked at."""


class Bin(Part):
    """Held-out comparisons of similar confidence."""

    count: int
    confidence: Number
    """Mean predicted probability of the favourite, in [0.5, 1]."""
    share: Number
    """How often the favourite was preferred; a tie counts half."""
    low: Number
    high: Number
    """The 95 % Wilson interval of the share."""


class About(Part):
    """What was graded, on what."""

    model: Words
    """The folder of the reward model."""
    data: Words
    """Where the judgements are from."""
    held_out: bool
    """Whether they are the ones that the fit left out; else all judgements of the data."""
    kind: Words
    round: int | None = None
    """The round of the run that the model is from."""
    members: int
    judgements: int
    comparisons: int
    """Pairs that the judgements imply, ties included."""
    ties: int
    candidates: int
    demonstrations: int = 0
    """What the fit counted beside them: each says that what was shown is better than what it answers."""


class Lengths(Part):
    """Does the reward pay for length?"""

    unit: Words
    spearman: Estimate
    pearson: Estimate
    baseline: Estimate
    """The accuracy of "the longer one wins" on the same comparisons."""
    when_longer: Estimate
    """The model's accuracy where the longer one was preferred."""
    when_shorter: Estimate
    buckets: list[Bucket]
    """By the absolute difference of lengths."""


class Calibration(Part):
    """Does the model know how sure it may be?"""

    log_loss: Estimate
    brier: Estimate
    error: Estimate
    """Expected calibration error."""
    bins: list[Bin]
    temperatures: Annotated[list[Number], Field(max_length=2)]
    """Fitted on one half, and on the other; empty where `log_loss_after` says why."""
    log_loss_after: Estimate
    """Each half measured with the other half's temperature."""
    error_after: Estimate


class Invariance(Part):
    """Largest differences where there should be none, on a few probes."""

    swap: Estimate
    """abs(P(a > b) + P(b > a) - 1), each from a batch of its own."""
    alone: Estimate
    """abs difference of scores alone and in one batch."""
    reversed: Estimate
    """The same, in one batch and in the batch turned round."""
    padding: Estimate
    """The same, of cut candidates alone and beside whole ones."""
    spread: Number
    """The standard deviation of the probes' scores, to compare with."""
    passed: bool


class Members(Part):
    """How far the members of the ensemble agree."""

    accuracy: list[Estimate]
    unanimous: Estimate
    """The share of comparisons on which all name the same winner."""


class Gold(Part):
    """Against the task's own, hidden value."""

    accuracy: Estimate
    """The share of compared pairs whose better one by gold has the higher score."""
    spearman: Estimate
    kendall: Estimate
    buckets: list[Bucket]
    """The accuracy against what was judged, by the absolute difference of golds."""


class Distance(Part):
    """How far the reward is from gold, step by step: 0 is the same task, 1 the opposite."""

    epic: Estimate
    direct: Estimate
    """The Pearson distance on the stored steps, without canonical shaping."""
    explained: Estimate
    """R^2 of the regression that stands in for gold between stored steps."""
    coverage: Words


class Drift(Part):
    """What a refit changed, on fixed candidates."""

    round: int
    spearman: Estimate
    """Rank correlation with the round before."""
    shift: Estimate
    """Of the mean score, in standard deviations of the round before."""


class LabelerPart(Part):
    """One labeler's judgements beside the model's."""

    name: Words
    accuracy: Estimate
    kappa: Estimate
    """Agreement beyond chance (Cohen 1960)."""
    gold: Estimate
    """How often the labeler agrees with gold."""
    error_rate: Estimate
    """As the fit estimated it."""


class Scatter(Part):
    """A sample of candidates to draw."""

    score: Points
    length: Points
    gold: Points
    """Empty where there is none."""


class ReportCard(Part):
    """How good a reward model is."""

    about: About
    accuracy: Estimate
    by_margin: list[Bucket]
    """By the absolute value of the model's own logit."""
    calibration: Calibration
    lengths: Lengths
    gold: Gold
    distance: Distance
    labelers: list[LabelerPart]
    members: Members
    invariance: Invariance
    drift: list[Drift]
    seconds: Estimate
    """To score 1000 candidates."""
    scatter: Scatter


class Seen(Part):
    """A round's evaluation by the newest reward."""

    round: int
    learned: Estimate
    """Mean score of a candidate."""
    won: Estimate
    """Share of candidates that are worth more than what the start did in their place; equal ones count half."""


class Hindsight(Part):
    """The rounds so far, in order, all scored by one reward."""

    fitted_round: int | None
    """The round of its fit; None for a reward that the run began with."""
    rounds: tuple[Seen, ...]


class Mistakes(Part):
    """A round's policy beside the expert. An error is 0 for the expert's action, and at most 1."""

    round: int
    eps: Number
    """Mean error in the states of the expert's own fresh episodes."""
    error: Points
    """Mean error at each step of the policy's own episodes that have got so far."""
    running: Points
    """The share of its episodes that have."""


class Shift(Part):
    """How a run's policies are beside an expert, in the order of rounds."""

    episodes: int
    """Of the policy's own, in each round, and of the expert's."""
    every: int
    """Steps that a point is the mean of."""
    rounds: tuple[Mistakes, ...]


class Regret(Part):
    """How far a round's policy is from the best one."""

    round: int
    regret: Number
    """A share of the span between the best and the worst policy."""


class Exact(Part):
    """A run in a world whose states are cells and all known: the regret of each round, and maps of the newest."""

    rows: tuple[Words, ...]
    """The grid from above."""
    cells: tuple[tuple[int, int], ...]
    """Row and column of each state, of which all that follows has one number."""
    gold: Points
    learned: Points
    """Mean rewards over actions."""
    visits: Points
    """The share of a discounted lifetime that the policy spends there."""
    worth: Points
    """Its discounted return from there, in gold."""
    moves: tuple[tuple[int, int], ...]
    """Where it goes, as rows and columns."""
    discount: Number
    """What both are discounted by in a step."""
    rounds: tuple[Regret, ...]

    @model_validator(mode="after")
    def _of_one_grid(self) -> Exact:
        """Each state lies on the grid, and has a number of each kind, where there are any."""
        counts = {len(one) for one in (self.gold, self.learned, self.visits, self.worth, self.moves) if one}
        if counts != {len(self.cells)} or any(not 0 <= i < len(self.rows) for i, _ in self.cells):
            raise ValueError(f"expected a number for each of {len(self.cells)} cells of the grid, got {sorted(counts)}")
        if any(not 0 <= j < len(self.rows[i]) for i, j in self.cells):
            raise ValueError("expected cells within their rows")
        return self


def read_part(kind: type[P], path: Path) -> P | None:
    """What a file holds; None where there is none, or it cannot be read as that."""
    try:
        return kind.model_validate_json(path.read_bytes())
    except (ValidationError, OSError):
        return None
