"""The whole text run, as its preset says it: minutes."""

from pathlib import Path

import pytest

from prefrl.config import Config
from prefrl.store import Store
from prefrl.types import Response


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.nightly)])
def test_reviews_become_positive_and_stay_fluent_from_few_labels(tmp_path: Path, seed: int) -> None:
    with Store[Response](tmp_path / "store") as store:
        rounds = list(Config.load("text/reviews", [f"seed={seed}"]).build(store).run())
        assert store.counts()["asked"] <= 300
    before, after = rounds[0].metrics, rounds[-1].metrics
    assert abs(before["evaluate/gold"]) < 0.15
    assert after["evaluate/gold"] >= 0.6
    assert after["evaluate/fluency"] >= 0.8 * before["evaluate/fluency"] > 0.4
    assert after["evaluate/kl"] < 5.0
