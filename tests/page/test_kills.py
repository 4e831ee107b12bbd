"""A server that is killed while people label: what was acknowledged is there, once."""

from __future__ import annotations

import pytest
from benchmark_runs import measured


@pytest.mark.slow
def test_after_25_kills_each_acknowledged_answer_is_stored_once_and_nobody_has_lost_a_session() -> None:
    found = measured("label_kill", "--short", seconds=600)
    assert found["kills"] == 25
    assert found["answers"] > 50
    assert (found["lost"], found["duplicates"], found["fault_kinds"]) == (0, 0, {})
    assert found["chain"] is True
