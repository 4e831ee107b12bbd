from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import pearsonr

from prefrl.components import settings_class
from prefrl.fit.trainer import FittingSettings, NothingToFit, fit, fit_judged, split
from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.store import Store
from prefrl.types import Comparison, Judged, Query, Ranking, Segment, batch

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


def test_held_out_comparisons_share_no_candidate_with_the_rest(make_segment: Callable[..., Segment]) -> None:
    pool = [make_segment() for _ in range(60)]
    rng = np.random.default_rng(0)
    queries = {q.id: q for q in (Query((pool[i], pool[j])) for i, j in (rng.choice(60, 2, False) for _ in range(40)))}
    judged = [judge(q) for q in queries.values()]
    data = batch(judged)
    held_out = split(data, judged, 0.3)
    assert 0 < held_out.sum() < len(data)
    assert not set(data.edges[held_out].flatten()) & set(data.edges[~held_out].flatten())


def test_what_was_held_out_once_is_never_trained_on_later(judged: list[Judged[Segment]]) -> None:
    def ids(count: int) -> set[str]:
        some = judged[:count]
        data = batch(some)
        return {some[g].query.id for g in data.group[split(data, some, 0.2)]}

    assert ids(100) <= ids(200) <= ids(300)
    assert len(ids(300)) == pytest.approx(60, abs=25)


def test_all_pairs_of_a_ranking_are_held_out_together(make_query: Callable[..., Query[Segment]]) -> None:
    queries = [make_query(0, 1, 2, 3) for _ in range(40)]
    judged = [Judged(q, Ranking(q.id, (0, 1, 2, 3))) for q in queries]
    data = batch(judged)
    held_out = split(data, judged, 0.3)
    assert all(len(set(held_out[data.group == g])) == 1 for g in np.unique(data.group))


def test_a_split_that_would_leave_nothing_to_train_on_holds_out_nothing(judged: list[Judged[Segment]]) -> None:
    one = [next(j for j in judged if int(j.query.id[:8], 16) < 0.5 * 2**32)]
    assert not split(batch(one), one, 0.5).any()
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
    with pytest.raises(NothingToFit, match="no judgements" if preference is None else "3 comparisons are ties"):
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

        def settle(self, stacked: Any) -> None:
            """Nothing to settle."""

    reward: Any = Sure()
    fitted = fit_judged(reward, judged, FittingSettings(epochs=1), np.random.default_rng(0))
    assert fitted.metrics["loss"] == fitted.metrics["loss_held_out"] == pytest.approx(0, abs=1e-6)
