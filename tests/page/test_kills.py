"""A server that is killed while people label: what was acknowledged is there, once."""

from __future__ import annotations

import pytest
from benchmark_runs import measured


@pytest.mark.parametrize(
    "kills", [pytest.param(10, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.nightly)]
)
def test_after_kills_each_acknowledged_answer_is_stored_once_and_nobody_has_lost_a_session(kills: int) -> None:
    found = measured("label_kill", "--kills", str(kills), seconds=60 * kills)
    assert found["kills"] == kills
    assert found["answers"] > 2 * kills
    assert (found["lost"], found["duplicates"], found["fault_kinds"]) == (0, 0, {})
    assert found["chain"] is True
