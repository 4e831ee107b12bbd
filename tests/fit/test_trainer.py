from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import pearsonr

from prefrl.components import ConfigError, settings_class
from prefrl.fit.pairs import batch
from prefrl.fit.settings import FittingSettings
from prefrl.fit.split import split
from prefrl.fit.trainer import NothingToFit, fit, fit_judged
from prefrl.judgements import Choice, Comparison, Demonstrated, Demonstration, Judged, Ranking, Rating
from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.store import Store
from prefrl.types import Query, Segment

WEIGHTS = np.array([1.0, -2.0, 0.5, 1.0, 0.0])


class Task:
    """Enough of a control task to build a reward model for the segments of `conftest`."""

    name, kind, observation_size, action_size, segment_steps, action_bounds = "planted", "control", 3, 2, 5, None


def model(members: int = 2, seed: int = 0) -> Any:
    settings: Any = settings_class("rewards", "mlp")
    return settings(members=members, hidden=(32,)).build(Task(), np.random.default_rng(seed))


def planted(segment: Segment) -> float:
    return float((np.concatenate([segment.observations, segment.actions], 1) @ WEIGHTS).sum())


def judge(query: Query[Segment]) -> Judged[Segment]:
    a, b = (planted(c) for c in query.candidates)
    return Judged(query, Comparison(query.id, float(a > b)))


@pytest.fixture
def judged(make_query: Callable[..., Query[Segment]]) -> list[Judged[Segment]]:
    return [judge(make_query()) for _ in range(300)]


def test_a_planted_reward_is_recovered(judged: list[Judged[Segment]], make_segment: Callable[..., Segment]) -> None:
    reward = model()
    fitted = fit_judged(reward, judged, FittingSettings(epochs=60), np.random.default_rng(0))
    assert fitted.metrics["accuracy_held_out"] > 0.85
    fresh = [make_segment() for _ in range(200)]
    assert pearsonr(reward.score(fresh), [planted(s) for s in fresh]).statistic > 0.95


def test_the_scores_that_learners_get_have_mean_zero_and_unit_scale_per_step(judged: list[Judged[Segment]]) -> None:
    reward = model()
    fit_judged(reward, judged, FittingSettings(epochs=5), np.random.default_rng(0))
    candidates = batch(judged).candidates
    x = np.stack([c.observations for c in candidates]), np.stack([c.actions for c in candidates])
    rewards = reward.rewards(*x)
    assert rewards.shape == (600, 5)
    assert rewards.mean() == pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(reward.score(list(candidates)), rewards.sum(1), rtol=1e-3, atol=1e-3)


def test_a_split_that_would_leave_nothing_to_train_on_holds_out_nothing(judged: list[Judged[Segment]]) -> None:
    one = [next(j for j in judged if int(j.query.id[:8], 16) < 0.5 * 2**32)]
    fitted = fit_judged(model(), one, FittingSettings(patience=2, held_out=0.5), np.random.default_rng(0))
    assert "accuracy_held_out" not in fitted.metrics
    assert len(fitted.predicted) == 0


def test_patience_stops_early_and_goes_back_to_the_best(judged: list[Judged[Segment]]) -> None:
    settings = FittingSettings(epochs=400, patience=5, learning_rate=1e-2, held_out=0.3)
    patient, stubborn = model(), model()
    stopped = fit_judged(patient, judged[:60], settings, np.random.default_rng(0))
    rushed = fit_judged(stubborn, judged[:60], settings.model_copy(update={"patience": 0}), np.random.default_rng(0))
    assert stopped.metrics["epochs"] < 400
    assert stopped.metrics["loss_held_out"] < rushed.metrics["loss_held_out"]


def test_with_the_bootstrap_members_differ_more_than_by_their_start(judged: list[Judged[Segment]]) -> None:
    def spread(bootstrap: bool) -> float:
        reward = model(members=4)
        settings = FittingSettings(epochs=80, bootstrap=bootstrap)
        fit_judged(reward, judged[:60], settings, np.random.default_rng(0))
        return float(reward.member_scores([c for j in judged[200:] for c in j.query.candidates]).std(0).mean())

    assert spread(True) > 1.1 * spread(False)


@pytest.mark.parametrize("ratings", [0, 10])
def test_a_member_computes_what_its_bootstrap_drew_and_learns_the_same(
    judged: list[Judged[Segment]], ratings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rated = [Judged(one.query, Rating(one.query.id, (1, i % 3), 3)) for i, one in enumerate(judged[50 : 50 + ratings])]
    seen: list[int] = []

    def weights(thrifty: bool) -> list[torch.Tensor]:
        reward = model()
        scores = reward.scores

        def watched(stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
            seen.append(int(stacked["used"].sum()) if "used" in stacked else 0)
            found: torch.Tensor = scores(stacked if thrifty else {k: x for k, x in stacked.items() if k != "used"})
            return found

        monkeypatch.setattr(reward, "scores", watched)
        fit_judged(reward, judged[:50] + rated, FittingSettings(epochs=3, held_out=0), np.random.default_rng(0))
        return [p.detach() for p in reward.parameters()]

    thrifty, lavish = weights(True), weights(False)
    for one, other in zip(thrifty[:-1], lavish[:-1], strict=True):  # the last bias moves by rounding alone
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    candidates = 2 * (50 + ratings) * 2 * 3  # of two members in three epochs
    assert 0.55 * candidates < sum(seen) / 2 < 0.75 * candidates  # 1 - 1/e of them


def test_the_same_judgements_and_seed_give_the_same_bytes(judged: list[Judged[Segment]]) -> None:
    def weights(seed: int) -> bytes:
        reward = model()
        fit_judged(reward, judged[:50], FittingSettings(epochs=3), np.random.default_rng(seed))
        return b"".join(p.detach().numpy().tobytes() for p in reward.parameters())

    assert weights(0) == weights(0) != weights(1)


@pytest.mark.parametrize("preference", [None, 0.5])
def test_nothing_to_learn_from_is_said(make_query: Callable[..., Query[Segment]], preference: float | None) -> None:
    queries = [make_query() for _ in range(3)]
    judged = [] if preference is None else [Judged(q, Comparison(q.id, preference)) for q in queries]
    with pytest.raises(NothingToFit, match="no judgements" if preference is None else "3 judgements are ties"):
        fit_judged(model(), judged, FittingSettings(), np.random.default_rng(0))


def test_a_candidate_with_nan_is_named_with_the_member(judged: list[Judged[Segment]]) -> None:
    bad = judged[0].query.candidates[0]
    bad.observations[0, 0] = np.nan
    with pytest.raises(FloatingPointError, match=f"reward member 0 scored candidate {bad.id[:12]} as nan"):
        fit_judged(model(), judged[:20], FittingSettings(held_out=0), np.random.default_rng(0))


def test_a_fit_records_the_snapshot_that_it_was_made_on(
    store: Store[Segment], make_query: Callable[..., Query[Segment]]
) -> None:
    store.ask([make_query(0.0, 1.0) for _ in range(10)])
    Oracle(OracleSettings()).answer(store, np.random.default_rng(0))
    fitted = fit(model(), store, FittingSettings(epochs=1), np.random.default_rng(0))
    assert fitted.metrics["snapshot"] == store.sequence
    assert fitted.metrics["comparisons"] == 10


def test_an_ensemble_fits_each_member_as_it_would_be_fitted_alone(judged: list[Judged[Segment]]) -> None:
    """Members share nothing but the order of the data: without clipping, one batched pass is E separate fits."""
    settings = FittingSettings(epochs=2, bootstrap=False, max_grad_norm=1e9)
    together = model(members=2)
    start = [p.detach().clone() for p in together.parameters()]
    fit_judged(together, judged[:50], settings, np.random.default_rng(0))
    for member in range(2):
        alone = model(members=1)
        with torch.no_grad():
            for mine, theirs in zip(alone.parameters(), start, strict=True):
                mine.copy_(theirs[member : member + 1])
        fit_judged(alone, judged[:50], settings, np.random.default_rng(0))
        pairs = list(zip(alone.parameters(), together.parameters(), strict=True))
        assert pairs[-1][0].numel() == 1
        for mine, theirs in pairs[:-1]:  # the last bias is a shift of all scores: its gradient is rounding alone
            torch.testing.assert_close(mine, theirs[member : member + 1], rtol=1e-4, atol=1e-5)


def test_a_confident_prediction_that_is_right_has_a_finite_loss(judged: list[Judged[Segment]]) -> None:
    class Sure:
        """Scores a hundred nats apart, in the right order."""

        members, fitted = 2, True

        def __init__(self) -> None:
            self._shift = torch.nn.Parameter(torch.zeros(1))

        def stack(self, candidates: Any) -> dict[str, torch.Tensor]:
            return {"x": torch.tensor([planted(c) for c in candidates], dtype=torch.float32)}

        def scores(self, stacked: dict[str, torch.Tensor]) -> torch.Tensor:
            return (1e4 * stacked["x"] + self._shift).expand(2, -1)

        def parameters(self) -> list[torch.nn.Parameter]:
            return [self._shift]

        def settle(self, stacked: Any, loss: Any) -> torch.Tensor:
            return self.scores(stacked).detach()

        def calibrate(self, temperature: float) -> None:
            """Nothing to calibrate."""

    reward: Any = Sure()
    settings = FittingSettings(epochs=1, weight_decay="adaptive")
    fitted = fit_judged(reward, judged, settings, np.random.default_rng(0))
    assert fitted.metrics["loss"] == fitted.metrics["loss_held_out"] == pytest.approx(0, abs=1e-6)


class Table:
    """A score of its own for each candidate: the likelihood alone decides."""

    fitted = False

    def __init__(self, members: int = 1) -> None:
        self.members, self._scores = members, torch.nn.Parameter(torch.zeros(members, 0))

    def stack(self, candidates: Any) -> dict[str, torch.Tensor]:
        self._scores = torch.nn.Parameter(torch.zeros(self.members, len(candidates)))
        return {"at": torch.arange(len(candidates))}

    def scores(self, stacked: dict[str, torch.Tensor]) -> torch.Tensor:
        return self._scores[:, stacked["at"]]

    def parameters(self) -> list[torch.nn.Parameter]:
        return [self._scores]

    def settle(self, stacked: Any, loss: Any) -> torch.Tensor:
        return self.scores(stacked).detach()

    def calibrate(self, temperature: float) -> None:
        """Nothing to calibrate."""


MLE = FittingSettings(epochs=3000, learning_rate=0.02, batch_size=10_000, held_out=0.0, max_grad_norm=1e9)
WORTH = np.array([0.0, 0.8, -0.5, 1.2, 0.3])


@pytest.fixture
def items(make_segment: Callable[..., Segment]) -> list[Segment]:
    return sorted((make_segment() for _ in WORTH), key=lambda c: c.id)


def outcomes(items: list[Segment], worth: Any, rng: np.random.Generator, tie: float, wrong: float) -> Any:
    """A comparison of each two items under Davidson's model with nu = `tie`, some of them wrong."""
    for i in range(len(items)):
        for j in range(i + 1, len(items)):
            query = Query((items[i], items[j]))
            a, b = np.exp(worth[i]), np.exp(worth[j])
            p = np.array([a, b, tie * np.sqrt(a * b)])
            drawn = rng.choice(3, p=p / p.sum())
            if rng.random() < wrong:
                drawn = rng.choice([k for k in range(3 if tie else 2) if k != drawn])
            yield Judged(query, Comparison(query.id, [1.0, 0.0, 0.5][drawn]))


def test_how_readily_ties_are_called_is_learned_beside_the_reward(items: list[Segment]) -> None:
    rng = np.random.default_rng(0)
    judged = [one for _ in range(150) for one in outcomes(items, WORTH, rng, tie=0.7, wrong=0.0)]
    reward: Any = Table()
    fitted = fit_judged(reward, judged, MLE.model_copy(update={"ties": "davidson", "epochs": 400}), rng)
    assert fitted.metrics["tie"] == pytest.approx(0.7, rel=0.15)
    found = reward.scores({"at": torch.arange(5)})[0].detach().numpy()
    np.testing.assert_allclose(found - found.mean(), WORTH - WORTH.mean(), atol=0.25)


@pytest.mark.parametrize(("ties", "tie"), [("half", 0.0), ("davidson", 0.7)])
def test_error_rates_of_labelers_are_learned_beside_the_reward(items: list[Segment], ties: str, tie: float) -> None:
    rng, rates = np.random.default_rng(0), {"good": 0.02, "blind": 0.5 if tie == 0.0 else 2 / 3, "hostile": 0.95}
    judged = []
    for name, wrong in rates.items():
        for _ in range(80 if name == "good" else 40):
            judged += [
                Judged(one.query, replace(one.judgement, labeler=name))
                for one in outcomes(items, 3 * WORTH, rng, tie, wrong)
            ]
    settings = MLE.model_copy(update={"ties": ties, "reliability": "learned", "epochs": 400})
    reward: Any = Table()
    fitted = fit_judged(reward, judged, settings, rng)
    for name, wrong in rates.items():
        assert fitted.metrics[f"error_rate/{name}"] == pytest.approx(wrong, abs=0.1)


@pytest.mark.parametrize(("ties", "nu"), [("davidson", 3.0), ("rao_kupper", 2.0)])
def test_modelled_ties_leave_a_right_model_calibrated(items: list[Segment], ties: str, nu: float) -> None:
    rng = np.random.default_rng(0)
    judged = [one for _ in range(60) for one in outcomes(items, WORTH, rng, tie=nu, wrong=0.0)]
    reward: Any = Table()
    settings = MLE.model_copy(update={"ties": ties, "epochs": 400})
    metrics = fit_judged(reward, judged, settings, rng).metrics
    assert metrics["calibration_error"] < 0.06
    assert metrics["temperature"] == 1.0  # nothing is held out


def test_a_second_answer_of_one_person_is_of_the_same_person(items: list[Segment]) -> None:
    some = list(outcomes(items, WORTH, np.random.default_rng(0), 0.0, 0.0))
    named = [
        replace(one, judgement=replace(one.judgement, labeler=n))
        for one, n in zip(some, ["ann", "ann#2"] * 5, strict=True)
    ]
    settings = MLE.model_copy(update={"reliability": "learned", "epochs": 1})
    reward: Any = Table()
    found = fit_judged(reward, named, settings, np.random.default_rng(0)).metrics
    assert [name for name in found if name.startswith("error_rate/")] == ["error_rate/ann"]


def test_ratings_of_single_candidates_are_held_out_and_measured_too(make_segment: Callable[..., Segment]) -> None:
    rated = [Query((make_segment(),)) for _ in range(60)]
    levels = [(planted(q.candidates[0]) > 0) + (planted(q.candidates[0]) > 3) for q in rated]
    judged = [Judged(q, Rating(q.id, (int(level),), 3)) for q, level in zip(rated, levels, strict=True)]
    fitted = fit_judged(model(), judged, FittingSettings(epochs=60, held_out=0.3), np.random.default_rng(0))
    assert len(fitted.predicted) > 5
    assert fitted.metrics["held_out"] >= 2 * len(fitted.predicted)
    assert np.isfinite(fitted.metrics["loss_held_out"])
    assert fitted.metrics["accuracy_held_out"] > 0.8


def test_an_input_that_a_network_hides_is_named_too(judged: list[Judged[Segment]]) -> None:
    bad = judged[3].query.candidates[1]
    bad.observations[0, 0] = np.inf  # tanh makes 1 of it
    for kind in ("mlp", "linear"):
        settings: Any = settings_class("rewards", kind)
        reward = settings().build(Task(), np.random.default_rng(0))
        with pytest.raises(FloatingPointError, match=f"candidate {bad.id[:12]} holds numbers that are not finite"):
            fit_judged(reward, judged[:20], FittingSettings(held_out=0), np.random.default_rng(0))


@pytest.mark.parametrize("given", [{"patience": 3}, {"weight_decay": "adaptive"}])
def test_what_needs_held_out_judgements_says_so(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="needs held-out judgements"):
        FittingSettings(held_out=0, **given)


def test_scores_are_centred_where_that_is_wanted(judged: list[Judged[Segment]]) -> None:
    def mean(centre: float) -> float:
        reward = model(1)
        with torch.no_grad():
            list(reward.parameters())[-1].fill_(1.0)  # the last bias
        settings = FittingSettings(epochs=60, learning_rate=0.03, centre=centre)
        fit_judged(reward, judged[:60], settings, np.random.default_rng(0))
        return abs(float(reward.raw_member_scores([c for j in judged[:60] for c in j.query.candidates]).mean()))

    assert mean(1.0) < 0.2 * mean(0.0)


def test_ratings_and_comparisons_are_fitted_on_one_reward(make_segment: Callable[..., Segment]) -> None:
    pool = [make_segment() for _ in range(240)]
    cuts = np.quantile([planted(s) for s in pool], [0.25, 0.5, 0.75])
    judged: list[Judged[Segment]] = []
    for i in range(0, 240, 3):
        three = Query(tuple(pool[i : i + 3]))
        worth = np.array([planted(c) for c in three.candidates])
        ranks = tuple(int(r) for r in np.argsort(np.argsort(-worth)))
        kinds = (
            Rating(three.id, tuple(int(x) for x in np.searchsorted(cuts, worth)), 4),
            Ranking(three.id, ranks),
            Choice(three.id, int(worth.argmax())),
        )
        judged.append(Judged(three, kinds[(i // 3) % 3]))
    reward = model()
    fitted = fit_judged(reward, judged, FittingSettings(epochs=60), np.random.default_rng(0))
    assert fitted.metrics["accuracy_held_out"] > 0.75
    fresh = [make_segment() for _ in range(200)]
    assert pearsonr(reward.score(fresh), [planted(s) for s in fresh]).statistic > 0.9


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_adaptive_weight_decay_keeps_overfitting_within_bounds(judged: list[Judged[Segment]], seed: int) -> None:
    """Not above 1.5, give or take what an epoch moves before it is corrected; below 1.1 little decay is left."""

    def ratio(weight_decay: Any) -> float:
        settings = FittingSettings(epochs=300, learning_rate=3e-3, held_out=0.3, weight_decay=weight_decay)
        part = judged[50 * seed : 50 * seed + 150]
        metrics = fit_judged(model(1, seed), part, settings, np.random.default_rng(seed)).metrics
        return metrics["loss_held_out"] / metrics["loss"]

    assert ratio(0.0) > 2.0
    assert 0.9 < ratio("adaptive") < 1.6


@pytest.mark.parametrize("denoise", ["filter", "flip"])
def test_wrong_labels_harm_less_when_improbable_ones_are_filtered(
    judged: list[Judged[Segment]], make_segment: Callable[..., Segment], denoise: Any
) -> None:
    rng = np.random.default_rng(0)
    noisy = [
        Judged(j.query, Comparison(j.query.id, 1 - j.judgement.preference)) if rng.random() < 0.25 else j  # type: ignore[union-attr]
        for j in judged
    ]
    fresh = [make_segment() for _ in range(300)]

    def recovered(**settings: Any) -> float:
        reward = model(1)
        fit_judged(reward, noisy, FittingSettings(epochs=60, **settings), np.random.default_rng(0))
        return float(pearsonr(reward.score(fresh), [planted(s) for s in fresh]).statistic)

    assert recovered(denoise=denoise) > recovered() + 0.02


def test_pairs_nobody_judged_make_the_model_surer_of_their_like_and_no_worse(
    judged: list[Judged[Segment]], make_segment: Callable[..., Segment]
) -> None:
    few, others = judged[:40], [make_segment() for _ in range(300)]
    fresh = [make_segment() for _ in range(300)]

    def fitted(**settings: Any) -> tuple[float, float]:
        """How well fresh segments are scored, and how sure the members are of fresh pairs."""
        reward = model()
        fitting = FittingSettings(epochs=80, held_out=0.0, weight_decay=0.1, **settings)
        fit_judged(reward, few, fitting, np.random.default_rng(0), others)
        raw = reward.raw_member_scores(fresh)
        sure = float(np.abs(raw[:, ::2] - raw[:, 1::2]).mean())
        return float(pearsonr(reward.score(fresh), [planted(s) for s in fresh]).statistic), sure

    (alone, sure_alone), (both, sure_both) = fitted(), fitted(pseudo_labels=1.0, confidence=0.8)
    assert sure_both > 1.1 * sure_alone
    assert both > alone - 0.03


def linear() -> Any:
    settings: Any = settings_class("rewards", "linear")
    return settings(members=4).build(Task(), np.random.default_rng(0))


def test_a_model_that_is_solved_for_needs_no_epochs(judged: list[Judged[Segment]]) -> None:
    some = [Judged(j.query, Comparison(j.query.id, 0.5)) if i % 10 == 0 else j for i, j in enumerate(judged)]
    fitted = fit_judged(linear(), some, FittingSettings(ties="davidson"), np.random.default_rng(0))
    assert fitted.metrics["epochs"] == 0
    assert 0.0 < fitted.metrics["tie"] < 0.8
    assert fitted.metrics["accuracy_held_out"] > 0.9


@pytest.mark.parametrize("given", [{"denoise": "flip"}, {"pseudo_labels": 1.0}, {"crop": 0.2}])
def test_what_needs_epochs_is_refused_where_a_model_is_solved_for(
    judged: list[Judged[Segment]], given: dict[str, Any]
) -> None:
    with pytest.raises(ConfigError, match=f"fitting.{next(iter(given))}: this reward is solved for"):
        fit_judged(linear(), judged, FittingSettings(**given), np.random.default_rng(0))


@pytest.mark.parametrize("ties", ["davidson", "rao_kupper"])
def test_where_nobody_called_a_tie_every_model_of_ties_is_bradley_and_terrys(
    judged: list[Judged[Segment]], ties: Any
) -> None:
    plain, with_ties = (
        fit_judged(model(), judged, FittingSettings(epochs=2, ties=t), np.random.default_rng(0)).metrics
        for t in ("half", ties)
    )
    assert with_ties == plain


def test_what_patience_goes_back_to_is_better_on_held_out_judgements_than_the_end(
    judged: list[Judged[Segment]],
) -> None:
    rng = np.random.default_rng(0)
    noisy = [Judged(j.query, Comparison(j.query.id, float(rng.random() < 0.5))) for j in judged[:150]]

    def held_out_loss(patience: int) -> float:
        settings = FittingSettings(epochs=60, learning_rate=3e-3, held_out=0.3, patience=patience)
        return fit_judged(model(1), noisy, settings, np.random.default_rng(0)).metrics["loss_held_out"]

    assert held_out_loss(60) < held_out_loss(0) - 0.01


def test_the_model_is_calibrated_by_the_temperature_that_is_reported(judged: list[Judged[Segment]]) -> None:
    reward = model()
    fitted = fit_judged(reward, judged, FittingSettings(epochs=5), np.random.default_rng(0))
    assert reward.state()["temperature"] == fitted.metrics["temperature"] != 1.0


def test_training_metrics_are_of_training_judgements_alone(judged: list[Judged[Segment]]) -> None:
    settings = FittingSettings(epochs=300, held_out=0.3)
    out = split(judged[:40], settings.held_out)
    turned = [reversed_answer(j) if held_out else j for j, held_out in zip(judged, out, strict=False)]
    metrics = fit_judged(model(1), turned, settings, np.random.default_rng(0)).metrics
    assert metrics["accuracy"] == 1.0
    assert metrics["accuracy_held_out"] < 0.5


def test_the_temperature_is_that_of_judgements_that_were_held_out(judged: list[Judged[Segment]]) -> None:
    """A model that fits what it was trained on, and is wrong on all else, is to be far less sure."""
    settings = FittingSettings(epochs=60, held_out=0.3)
    out = split(judged[:40], settings.held_out)
    turned = [reversed_answer(j) if held_out else j for j, held_out in zip(judged, out, strict=False)]
    metrics = fit_judged(model(1), turned, settings, np.random.default_rng(0)).metrics
    assert metrics["loss"] < 0.2  # it could be surer still of these
    assert metrics["temperature"] > 3.0


def reversed_answer(one: Judged[Segment]) -> Judged[Segment]:
    assert isinstance(one.judgement, Comparison)
    return Judged(one.query, Comparison(one.query.id, 1 - one.judgement.preference))


def test_judgements_that_contradict_each_other_balance(judged: list[Judged[Segment]]) -> None:
    query = judged[0].query
    both = [Judged(query, Comparison(query.id, p, name)) for name in ("ann", "ben") for p in (0.0, 1.0)]
    reward = model(1)
    settings = FittingSettings(epochs=200, held_out=0, bootstrap=False)
    found = fit_judged(reward, both, settings, np.random.default_rng(0)).metrics
    assert found["loss"] == pytest.approx(np.log(2), abs=1e-3)
    assert np.ptp(reward.raw_member_scores(list(query.candidates))) < 0.05


def test_an_assumed_error_rate_is_part_of_what_is_fitted(items: list[Segment]) -> None:
    query = Query((items[0], items[1]))
    judged = [Judged(query, Comparison(query.id, p)) for p in (1.0, 1.0, 1.0, 0.0)]
    for error_rate, right in ((0.0, 0.75), (0.2, (0.75 - 0.1) / 0.8)):  # a blind answer is right half the time
        reward: Any = Table()
        settings = MLE.model_copy(update={"error_rate": error_rate, "epochs": 600, "learning_rate": 0.1})
        fit_judged(reward, judged, settings, np.random.default_rng(0))
        first, second = reward.parameters()[0][0].tolist()
        assert 1 / (1 + np.exp(second - first)) == pytest.approx(right, abs=1e-3)


def test_cropped_segments_still_teach(judged: list[Judged[Segment]], make_segment: Callable[..., Segment]) -> None:
    reward = model()
    fit_judged(reward, judged, FittingSettings(epochs=60, crop=0.4), np.random.default_rng(0))
    fresh = [make_segment() for _ in range(200)]
    assert pearsonr(reward.score(fresh), [planted(s) for s in fresh]).statistic > 0.9


def test_what_was_shown_is_better_than_what_it_answers(tmp_path: Path, make_segment: Callable[..., Segment]) -> None:
    """Demonstrations and judgements in one fit; those that stand for themselves say nothing."""
    with Store[Segment](tmp_path) as store:
        own = [make_segment() for _ in range(60)]
        better = [replace(one, actions=one.actions + np.array([2.0, 0.0], np.float32)) for one in own]
        queries = [Query((one,)) for one in own]
        store.ask(queries)
        store.keep(better)
        store.answer([Demonstration(q.id, b.id) for q, b in zip(queries[1:], better[1:], strict=True)])
        store.answer([Demonstration(queries[0].id, own[0].id)])
        off = FittingSettings(demonstrations=0.0)
        with pytest.raises(NothingToFit):
            fit(model(), store, off, np.random.default_rng(0))
        pair = judge(Query((make_segment(), make_segment())))
        store.ask([pair.query])
        store.answer([pair.judgement])
        reward = model()
        fitted = fit(reward, store, FittingSettings(epochs=40), np.random.default_rng(0))
        assert (fitted.metrics["judgements"], fitted.metrics["shown"]) == (60, 59)
        assert not any("/" in name for name in fit(model(), store, off, np.random.default_rng(0)).metrics)
        assert (reward.score(better) > reward.score(own)).mean() > 0.9
        assert "shown" not in fit(model(), store, off, np.random.default_rng(0)).metrics


def test_what_was_shown_counts_by_its_weight_and_that_of_the_fit() -> None:
    own, like = (Segment(np.full((2, 1), x, np.float32), np.zeros((2, 1), np.float32), "e", 0) for x in (0.0, 1.0))
    query = Query((own,))
    found = Demonstrated(query, like, Demonstration(query.id, like.id, "ann", weight=2.0)).implied(0.5)
    assert found is not None
    assert isinstance(found.judgement, Comparison)
    assert (found.judgement.weight, found.judgement.labeler) == (1.0, "ann")
    assert found.judgement.preference == float(found.query.candidates[0].id == like.id)
    assert Demonstrated(query, own, Demonstration(query.id, own.id)).implied(1.0) is None


def test_only_the_newest_answers_count_where_that_is_said(
    tmp_path: Path, judged: list[Judged[Segment]], make_segment: Callable[..., Segment]
) -> None:
    with Store[Segment](tmp_path) as store:
        store.ask([one.query for one in judged[:30]])
        store.answer([one.judgement for one in judged[:30]])
        own = [make_segment() for _ in range(6)]
        queries = [Query((one,)) for one in own]
        store.ask(queries)
        store.keep([make_segment()])
        like = make_segment()
        store.keep([like])
        store.answer([Demonstration(query.id, like.id) for query in queries])
        few = FittingSettings(epochs=1, newest=4)
        metrics = fit(model(), store, few, np.random.default_rng(0)).metrics
        assert (metrics["judgements"], metrics["shown"]) == (8, 4)
        every = fit(model(), store, FittingSettings(epochs=1), np.random.default_rng(0)).metrics
        assert (every["judgements"], every["shown"]) == (36, 6)
        apart = FittingSettings(epochs=1, newest=4, shown_as="piles")
        piles = fit(model(), store, apart, np.random.default_rng(0)).metrics
        assert (piles["judgements"], piles["shown"]) == (4 + 2 * 4, 2 * 4)


def test_a_fit_on_judgements_and_demonstrations_says_what_each_kind_had(
    judged: list[Judged[Segment]], make_segment: Callable[..., Segment]
) -> None:
    """The last ones are what demonstrations imply; those held out count in no weight, and a share is one of the sum."""
    heavy = [replace(one, judgement=replace(one.judgement, weight=3.0)) for one in judged[40:60]]
    settings, together = FittingSettings(epochs=3, held_out=0.25), [*judged[:40], *heavy]
    rng = np.random.default_rng
    found = fit_judged(model(), together, settings, rng(0), shown=20).metrics
    plain = fit_judged(model(), together, settings, rng(0)).metrics
    assert {name: value for name, value in found.items() if "/" not in name} == plain
    trained, held_out = ([found[f"{key}/{kind}"] for kind in ("judged", "shown")] for key in ("trained", "held_out"))
    assert [a + b for a, b in zip(trained, held_out, strict=True)] == [40, 20]
    assert [found["weight/judged"], found["weight/shown"]] == [trained[0], 3 * trained[1]]
    assert found["loss_share/judged"] + found["loss_share/shown"] == pytest.approx(1)
    split_up = [
        found[f"accuracy_held_out/{kind}"] * count for kind, count in zip(("judged", "shown"), held_out, strict=True)
    ]
    assert sum(split_up) / sum(held_out) == pytest.approx(found["accuracy_held_out"])
