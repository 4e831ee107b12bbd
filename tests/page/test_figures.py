"""The dashboard's numbers, from a store."""

import pytest

from prefrl.judgements import Comparison, Skip
from prefrl.page.figures import Dashboard, Figures
from prefrl.storage.log import row
from prefrl.store import Store
from prefrl.types import Query, Response


@pytest.fixture
def labelled(text_store: Store[Response]) -> Store[Response]:
    responses = [Response("p", str(i)) for i in range(12)]
    queries = [Query((responses[i], responses[i + 1])) for i in range(0, 12, 2)]
    text_store.ask(queries[:4])
    text_store.ask(queries[4:], purpose="check", expected=[0, 1])
    with text_store.log.transaction() as tx:
        for name, role in (("ann", "annotator"), ("ben", "annotator"), ("eve", "admin"), ("run", "trainer")):
            tx.append(row(f"annotator:{name}", "annotator", actor=name, body={"role": role}))
        tx.append(row("flag-1", "flag", queries[0].id, "ben", {"text": "both are empty"}))
    text_store.answer([Comparison(q.id, 1.0, name, shown=(0, 1)) for q in queries[:3] for name in ("ann", "ben")])
    text_store.answer([Comparison(queries[0].id, 0.0, "oracle"), Skip(queries[3].id, "skip", "ann")])
    text_store.answer([Comparison(q.id, 1.0, "ann", shown=(1, 0)) for q in queries[4:]])
    return text_store


def figures(store: Store[Response], dashboard: Dashboard, overlap: int = 2) -> Figures:
    with store.log.reading() as connection:
        return dashboard.figures(connection, overlap)


def test_a_store_has_figures_of_its_people(labelled: Store[Response]) -> None:
    found = figures(labelled, Dashboard())
    assert (found.asked, found.answered, found.open, found.skipped, found.incomparable) == (4, 3, 1, 1, 0)
    assert [(p.name, p.answers, p.skips) for p in found.annotators] == [("ann", 5, 1), ("ben", 3, 0), ("eve", 0, 0)]
    ann, ben, eve = found.annotators
    assert (ann.checks.value, ann.checks.count, ann.left.count) == (0.5, 2, 5)
    assert (ben.agreement.value, eve.agreement.value) == (1.0, None)
    assert (ann.last_seen is None, eve.last_seen) == (False, None)
    assert (found.agreement.raw.value, found.agreement.raw.count) == (1.0, 3), "an oracle is nobody"
    assert [(f["actor"], f["text"]) for f in found.flags] == [("ben", "both are empty")]
    assert (found.throughput_unit, sum(count for _, count in found.throughput)) == ("minute", 8)


def test_what_is_new_in_the_log_is_followed(labelled: Store[Response]) -> None:
    dashboard = Dashboard()
    before = figures(labelled, dashboard)
    queries = labelled.open_queries()
    labelled.answer([Comparison(queries[0].id, 0.0, "ben", shown=(1, 0))])
    labelled.retract(queries[0].id, "ben")
    labelled.answer([Comparison(queries[0].id, 1.0, "ben", shown=(1, 0))])
    after = figures(labelled, dashboard)
    assert [p.answers for p in after.annotators] == [p.answers + (p.name == "ben") for p in before.annotators]
    fresh = figures(labelled, Dashboard())
    assert after == fresh, "following the log and reading it anew come to the same"


def test_an_empty_store_has_figures(text_store: Store[Response]) -> None:
    found = figures(text_store, Dashboard(fps=20.0))
    assert (found.asked, found.open, found.annotators, found.flags) == (0, 0, [], [])
    assert found.agreement.cohen.why == "there are no answers"
