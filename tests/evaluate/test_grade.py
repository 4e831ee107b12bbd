"""The report card of a reward model that is known by heart."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from linear_reward import LinearReward, segment

from prefrl import Config
from prefrl.evaluate.card import ReportCard
from prefrl.evaluate.grade import Habits, Subject, grade, habits, judgements
from prefrl.fit.metrics import accuracy, brier, calibration_error
from prefrl.fit.pairs import batch
from prefrl.fit.settings import FittingSettings
from prefrl.judgements import Choice, Comparison, Judged, Ranking, Rating
from prefrl.rundir import Run
from prefrl.stages import report_card
from prefrl.store import Store
from prefrl.types import Query, Response, Segment, gold_score

WEIGHTS = (1.0, -1.0, 0.5)


def judged(
    count: int, rng: np.random.Generator, labelers: Sequence[str] = ("ann",), gold: bool = True
) -> list[Judged[Segment]]:
    """Comparisons by people who follow Bradley and Terry on the gold."""
    found = []
    for i in range(count):
        query = Query((segment(rng, 2 * i, WEIGHTS), segment(rng, 2 * i + 1, WEIGHTS)))
        first, second = (gold_score(c) for c in query.candidates)
        won = float(rng.random() < 1 / (1 + np.exp(second - first)))
        if not gold:
            query = Query(tuple(Segment(c.observations, c.actions, c.episode, c.start) for c in query.candidates))
        found.append(Judged(query, Comparison(query.id, won, labelers[i % len(labelers)])))
    return found


def test_the_true_reward_gets_a_good_card(rng: np.random.Generator) -> None:
    card = grade(Subject(LinearReward(WEIGHTS, WEIGHTS), judged(400, rng, ("ann", "bob"))), rng)
    assert card.gold.spearman.value == card.gold.kendall.value == pytest.approx(1.0)
    assert card.distance.epic.value == pytest.approx(0.0, abs=1e-3)
    assert card.accuracy.value is not None
    assert card.accuracy.value > 0.75
    assert card.calibration.temperatures == pytest.approx([1.0, 1.0], abs=0.35)
    assert card.calibration.error.value is not None
    assert card.calibration.error.value < 0.06
    assert [one.name for one in card.labelers] == ["ann", "bob"]
    assert [one.accuracy.count for one in card.labelers] == [200, 200]
    assert card.members.unanimous.value == 1.0
    assert card.invariance.passed
    assert "all candidates have length 6" in card.lengths.spearman.why
    assert card.by_margin[0].accuracy.value < card.by_margin[-1].accuracy.value  # type: ignore[operator]


def test_its_numbers_are_those_of_the_fit(rng: np.random.Generator) -> None:
    some = judged(60, rng)
    reward = LinearReward([0.7, -0.2, 0.9], [0.1, -1.0, 0.2])
    card, data = grade(Subject(reward, some), rng), batch(some)
    raw = reward.raw_member_scores(data.candidates)
    logits = raw[:, data.edges[:, 0]] - raw[:, data.edges[:, 1]]
    predicted, y = (1 / (1 + np.exp(-logits))).mean(0), data.preference
    assert card.accuracy.value == pytest.approx(accuracy(predicted, y))
    assert card.calibration.brier.value == pytest.approx(brier(predicted, y))
    assert card.calibration.error.value == pytest.approx(calibration_error(predicted, y))
    by_hand = -(y * np.log(predicted) + (1 - y) * np.log(1 - predicted)).mean()
    assert card.calibration.log_loss.value == pytest.approx(by_hand)


def test_a_model_that_is_too_sure_is_found_out_and_mended_on_the_other_half(rng: np.random.Generator) -> None:
    card = grade(Subject(LinearReward([4.0, -4.0, 2.0]), judged(300, rng)), rng)
    assert card.calibration.temperatures == pytest.approx([4.0, 4.0], rel=0.4)
    before, after = card.calibration.log_loss.value, card.calibration.log_loss_after.value
    assert before is not None
    assert after is not None
    assert after < before - 0.1


def test_a_fit_that_knows_of_mistakes_and_ties_is_not_blamed_for_them(rng: np.random.Generator) -> None:
    some = judged(1000, rng, ("ann", "bob"))
    turned = []
    for one in some:
        assert isinstance(one.judgement, Comparison)
        wrong = one.judgement.labeler == "bob" and rng.random() < 0.4
        said = abs(one.judgement.preference - wrong)
        turned.append(Judged(one.query, replace(one.judgement, preference=said)))
    reward = LinearReward(WEIGHTS, WEIGHTS)
    blamed = grade(Subject(reward, turned), rng).calibration
    known = grade(Subject(reward, turned, habits=Habits(error_rates={"ann": 0.0, "bob": 0.4})), rng).calibration
    assert blamed.error.value is not None
    assert known.error.value is not None
    assert known.error.value < 0.04 < 0.08 < blamed.error.value
    assert known.temperatures == pytest.approx([1.0, 1.0], abs=0.35)


def test_a_reward_for_length_is_found_out(rng: np.random.Generator) -> None:
    found = []
    for i in range(80):
        query = Query(tuple(Response(f"p{i}", f"{i}{j}", tokens=(1,) * int(rng.integers(1, 40))) for j in range(2)))
        lengths = [len(c.tokens) for c in query.candidates]
        found.append(Judged(query, Comparison(query.id, float(lengths[0] > lengths[1]), "ann")))
    card = grade(Subject(LinearReward([0.1]), found), rng)
    assert card.lengths.unit == "tokens"
    assert card.lengths.spearman.value == card.lengths.pearson.value == pytest.approx(1.0)
    assert card.lengths.baseline.value == card.accuracy.value
    assert card.gold.accuracy.why == card.gold.spearman.why == "no gold is known"
    assert card.distance.epic.why == "for control only"
    assert card.scatter.gold == []
    assert len(card.scatter.score) == 160


def test_every_kind_of_judgement_is_graded(rng: np.random.Generator) -> None:
    some = [Query(tuple(segment(rng, 3 * i + j) for j in range(3))) for i in range(8)]
    answers = [Ranking(q.id, (0, 1, 1), "r") for q in some[:3]] + [Choice(q.id, 2, "c") for q in some[3:6]]
    ratings = [Rating(q.id, (0, 3, 4), 5, "s") for q in some[6:]]
    known = [Judged(q, a) for q, a in zip(some, [*answers, *ratings], strict=True)]
    card = grade(Subject(LinearReward(WEIGHTS), known), rng)
    assert (card.about.judgements, card.about.comparisons, card.about.ties) == (8, 3 * 3 + 3 * 2 + 2 * 3, 3)
    assert card.accuracy.how == "bootstrap over 8 components"


@pytest.mark.parametrize(("count", "preference"), [(1, 1.0), (3, 0.5)])
def test_little_data_gives_a_card_with_reasons(count: int, preference: float, rng: np.random.Generator) -> None:
    some = [Judged(one.query, Comparison(one.query.id, preference)) for one in judged(count, rng, gold=False)]
    card = grade(Subject(LinearReward(WEIGHTS), some), rng)
    assert ReportCard.model_validate_json(card.model_dump_json()) == card
    assert (card.accuracy.value is None) == (preference == 0.5)
    assert card.calibration.temperatures == []
    assert "fewer than 20" in card.calibration.log_loss_after.why


def test_what_cannot_be_graded_is_refused_with_a_reason(rng: np.random.Generator) -> None:
    some = judged(3, rng)
    with pytest.raises(ValueError, match="nothing to grade on"):
        grade(Subject(LinearReward(WEIGHTS), []), rng)
    with pytest.raises(ValueError, match="has not been fitted"):
        grade(Subject(LinearReward(WEIGHTS, fitted=False), some), rng)
    with pytest.raises(ValueError, match=r"reward member 1 scored candidate [0-9a-f]{12} as nan"):
        grade(Subject(LinearReward(WEIGHTS, [np.nan] * 3), some), rng)


def test_gold_comes_from_the_store_where_it_lies_there(store: Store[Segment], rng: np.random.Generator) -> None:
    known, unknown = judged(1, rng)[0], judged(1, np.random.default_rng(1), gold=False)[0]
    store.ask([known.query, unknown.query])
    store.answer([known.judgement, unknown.judgement])
    found = judgements(store)
    assert [all(c.gold is not None for c in one.query.candidates) for one in found] == [True, False]
    assert [one.query.id for one in found] == [known.query.id, unknown.query.id]
    torn = next(Path(store.folder).glob("gold/*/*"))
    torn.write_bytes(b"")
    with pytest.raises(ValueError, match="cannot be read"):
        judgements(store)


def test_habits_are_those_of_the_newest_fit() -> None:
    rows: list[dict[str, float]] = [
        {"fit/error_rate/ann": 0.3, "fit/tie": 0.4, "fit/loss": 2, "round": 1},
        {"fit/error_rate/ann": 0.1, "fit/loss": 1},
        {"round": 3},
    ]
    found = habits(FittingSettings(ties="davidson", error_rate=0.2), rows)
    assert (found.error_rates, found.tie) == ({"ann": 0.1}, None)
    assert found.answering(["ann", "eve"]).error.tolist() == [0.1, 0.1]  # type: ignore[union-attr]
    before = habits(FittingSettings(ties="davidson", error_rate=0.3), rows[:1]).answering(["ann", "eve"])
    assert (before.ties, before.tie) == ("davidson", 0.4)
    assert before.error.tolist() == pytest.approx([0.3, 0.2])  # type: ignore[union-attr]
    assert habits(FittingSettings(), []).error_rates == {}


def test_the_cards_of_a_run_discount_as_its_learner_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []

    def graded(subject: Subject, rng: np.random.Generator) -> ReportCard:
        seen.append(subject.discount)
        return grade(subject, rng)

    monkeypatch.setattr("prefrl.rundir.grade", graded)
    monkeypatch.setattr("prefrl.stages.rewards.grade", graded)
    small = ["loop.rounds=1", "loop.labels=24", "fitting.epochs=1", "fitting.held_out=0.5", "learner.kind=sb3"]
    config = Config.load("control/toy", [*small, "learner.steps_per_round=320", "learner.options={gamma: 0.9}"])
    with Run(config, tmp_path / "run") as run:
        list(run)
        run.report()
    report_card(tmp_path / "run")
    assert seen == [0.9, 0.9]
