"""What people show: actions in the policy's states and rewritten texts, as demonstrations or refused with a reason."""

from __future__ import annotations

import errno
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from web_service import answering, ask_for, browser, invite, log_in, serving

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.toys import PointSettings
from prefrl.exchange.bundles import export_bundle, import_bundle
from prefrl.improve.clone import CloneSettings
from prefrl.label.web import WebSettings
from prefrl.page.service import Service
from prefrl.page.shown import ActionShowing, TextShowing
from prefrl.reward_models.mlp import MLPSettings
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

STEPS = 4
BOX = ActionShowing(2, (-np.ones(2, np.float32), np.ones(2, np.float32)))
CHOICES = ActionShowing(3, None)
SHORT = TextShowing(6, lambda text: (*range(len(text.split())), 9))
Post = Callable[..., Any]


def clip(number: int, discrete: bool = False) -> Segment:
    rng = np.random.default_rng(number)
    seen = rng.uniform(-1, 1, (STEPS, 2))
    actions = np.eye(3)[[0, 1, 2, 1]] if discrete else rng.uniform(-1, 1, (STEPS, 2))
    return Segment(seen.astype(np.float32), actions.astype(np.float32), f"e{number}", 0, seen, np.zeros(STEPS))


@pytest.fixture
def service(store: Store[Segment]) -> Iterator[Service]:
    """Five clips, each to be corrected."""
    store.ask([Query((clip(number),)) for number in range(5)])
    with serving(store, ask="action", shows=BOX) as opened:
        yield opened


@pytest.fixture
def ann(service: Service) -> TestClient:
    return log_in(service, "ann")


@pytest.fixture
def texts(text_store: Store[Response]) -> Iterator[Service]:
    """Two responses, each to be rewritten."""
    text_store.ask([Query((Response(f"prompt {n}", " as it was", (1, 2), (3, 9)),)) for n in range(2)])
    with serving(text_store, "text", ask="rewrite", shows=SHORT) as opened:
        yield opened


def show(client: TestClient, assignment: str, **shown: Any) -> Any:
    return client.post("/api/answers", json=answering(assignment, "shown", shown=shown))


def test_actions_are_stored_with_the_policys_own_states(service: Service, ann: TestClient) -> None:
    (card,) = ask_for(ann)
    rows = [[0.5, -1.0], None, [1.0, 1.0], [0.25, 0.125]]
    assert show(ann, card["assignment_id"], actions=rows).status_code == 200
    (one,) = service.store.demonstrations()
    (own,) = one.query.candidates
    wanted = [own.actions[t] if row is None else row for t, row in enumerate(rows)]
    np.testing.assert_array_equal(one.like.actions, np.array(wanted, np.float32))
    np.testing.assert_array_equal(one.like.observations, own.observations)
    np.testing.assert_array_equal(one.like.states, own.states)
    assert (one.like.episode, one.like.gold, one.demonstration.labeler) == (own.episode, None, "ann")
    assert one.implied(1.0) is not None
    assert service.store.counts() == {"asked": 5, "answered": 1, "skipped": 0, "demonstrations": 1}


def test_an_admin_takes_along_what_people_showed(service: Service, ann: TestClient) -> None:
    boss, address = log_in(service, "boss", "admin"), "/api/admin/export/demonstrations"
    refused = boss.get(address)
    assert (refused.status_code, "holds no demonstration" in refused.text) == (409, True)
    show(ann, ask_for(ann)[0]["assignment_id"], actions=[[0.5, -1.0], *REST])
    assert boss.get("/api/admin/overview").json()["exports"] == ["demonstrations", "bundle", "minari"]
    with np.load(io.BytesIO(boss.get(address).content)) as found:
        np.testing.assert_array_equal(found["actions"][0], np.array([0.5, -1.0], np.float32))


def test_who_agrees_with_every_step_shows_the_policys_own_clip(service: Service, ann: TestClient) -> None:
    (card,) = ask_for(ann)
    assert show(ann, card["assignment_id"], actions=[None] * STEPS).status_code == 200
    (one,) = service.store.demonstrations()
    assert one.like.id == one.query.candidates[0].id
    assert one.implied(1.0) is None


def test_the_page_is_told_what_the_policy_did_and_nothing_of_its_worth(service: Service, ann: TestClient) -> None:
    (card,) = ask_for(ann)
    (own,) = service.store.query(card["query_id"]).candidates
    np.testing.assert_array_equal(np.float32(card["items"][0]["actions"]), own.actions)
    assert ann.get("/api/me").json()["page"]["ask"] == "action"
    assert own.gold is None


def test_discrete_actions_are_told_and_shown_by_their_numbers(store: Store[Segment]) -> None:
    store.ask([Query((clip(0, discrete=True),))])
    with serving(store, ask="action", shows=CHOICES) as service:
        ann = log_in(service, "ann")
        (card,) = ask_for(ann)
        assert card["items"][0]["actions"] == [[0.0], [1.0], [2.0], [1.0]]
        assert show(ann, card["assignment_id"], actions=[[2], None, [0], [0]]).status_code == 200
        (one,) = store.demonstrations()
        assert one.like.actions.argmax(1).tolist() == [2, 1, 0, 0]
        assert one.like.actions.sum() == STEPS


REST: list[Any] = [None, None, None]


@pytest.mark.parametrize(
    ("shows", "rows", "said"),
    [
        (BOX, [[0.0, 1.0]], "4 steps"),
        (BOX, [None] * (STEPS + 1), "4 steps"),
        (BOX, [[0.0, 1.0001], *REST], "step 1: expected a number from -1 to 1 in dimension 2, got 1.0001"),
        (BOX, [*REST, [-1e300, 0.0]], "step 4: expected a number from -1 to 1 in dimension 1"),
        (BOX, [[0.0], *REST], "an action has 2 numbers, got 1"),
        (BOX, [[], *REST], "at least 1"),
        (BOX, [["0.5", 0.0], *REST], "valid number"),
        (BOX, [[True, 0.0], *REST], "valid number"),
        (BOX, 1, "valid list"),
        (CHOICES, [[3], *REST], "expected the number of an action, 0 to 2, got 3"),
        (CHOICES, [[-1], *REST], "0 to 2, got -1"),
        (CHOICES, [[0.5], *REST], "0 to 2, got 0.5"),
        (CHOICES, [[0, 1], *REST], "got 2 numbers"),
    ],
)
def test_what_is_no_action_is_refused_with_the_step_and_the_reason(
    store: Store[Segment], shows: ActionShowing, rows: Any, said: str
) -> None:
    store.ask([Query((clip(0, discrete=shows is CHOICES),))])
    with serving(store, ask="action", shows=shows) as service:
        ann = log_in(service, "ann")
        (card,) = ask_for(ann)
        answer = show(ann, card["assignment_id"], actions=rows)
        assert (answer.status_code, said in answer.json()["error"]) == (422, True), answer.text
        draft = {"assignment_id": card["assignment_id"], "shown": {"actions": rows}}
        assert said in ann.post("/api/drafts", json=draft).text
        assert show(ann, card["assignment_id"], actions=[None] * STEPS).status_code == 200, "the question is open still"
        assert len(store.answers()) == 1


def test_not_a_number_is_no_json(ann: TestClient, service: Service) -> None:
    (card,) = ask_for(ann)
    body = str(answering(card["assignment_id"], "shown", shown={"actions": [["NAN", 0.0]] * STEPS}))
    body = body.replace("'NAN'", "NaN").replace("'", '"')
    answer = ann.post("/api/answers", content=body, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)
    assert service.store.answers() == []


@pytest.mark.parametrize(
    ("outcome", "more"),
    [
        ("first", {}),
        ("tie", {}),
        ("ranking", {"ranking": [0, 1]}),
        ("shown", {}),
        ("shown", {"shown": {}}),
        ("shown", {"shown": {"actions": [None], "text": "x"}}),
        ("shown", {"shown": {"text": "not a clip"}}),
        ("skip", {"shown": {"actions": [None] * STEPS}}),
    ],
)
def test_a_question_of_one_clip_takes_actions_and_no_judgement(
    service: Service, ann: TestClient, outcome: str, more: dict[str, Any]
) -> None:
    (card,) = ask_for(ann)
    assert ann.post("/api/answers", json=answering(card["assignment_id"], outcome, **more)).status_code == 422
    assert service.store.answers() == []


def test_a_question_of_two_takes_no_actions(store: Store[Segment], make_query: Callable[..., Query[Segment]]) -> None:
    store.ask([make_query(0.0, 1.0)])
    with serving(store) as service:
        ann = log_in(service, "ann")
        (card,) = ask_for(ann)
        answer = show(ann, card["assignment_id"], actions=[None] * 5)
        assert (answer.status_code, "judgement" in answer.text) == (422, True)
        draft = {"assignment_id": card["assignment_id"], "shown": {"actions": [None]}}
        assert ann.post("/api/drafts", json=draft).status_code == 422


def test_sending_twice_is_showing_once_and_what_is_taken_back_can_be_shown_anew(
    service: Service, ann: TestClient
) -> None:
    (card,) = ask_for(ann)
    body = answering(card["assignment_id"], "shown", shown={"actions": [[1.0, 0.0]] * STEPS})
    receipts = [ann.post("/api/answers", json=body).json() for _ in range(2)]
    assert [one["duplicate"] for one in receipts] == [False, True]
    assert receipts[0]["seq"] == receipts[1]["seq"]
    taken = {"submission_id": "0" * 32, "assignment_id": card["assignment_id"]}
    undone = ann.post("/api/undo", json=taken).json()
    assert undone["assignment"] == card
    assert undone["answer"]["shown"]["actions"] == [[1.0, 0.0]] * STEPS
    assert service.store.demonstrations() == []
    assert show(ann, card["assignment_id"], actions=[[0.0, 1.0]] * STEPS).status_code == 200
    (one,) = service.store.demonstrations()
    assert one.like.actions.tolist() == [[0.0, 1.0]] * STEPS
    (entry,) = ann.get("/api/history").json()["entries"]
    assert entry["answer"]["outcome"] == "shown"


def test_a_skip_goes_to_somebody_else_and_no_telling_is_an_answer(service: Service, ann: TestClient) -> None:
    first, second = ask_for(ann, 2)
    for card, outcome in ((first, "skip"), (second, "incomparable")):
        assert ann.post("/api/answers", json=answering(card["assignment_id"], outcome)).status_code == 200
    held = {card["query_id"] for card in ask_for(log_in(service, "bob"), 6)}
    assert first["query_id"] in held
    assert second["query_id"] not in held
    assert service.store.demonstrations() == []


def test_the_dashboard_counts_what_was_shown(service: Service, ann: TestClient) -> None:
    (card,) = ask_for(ann)
    show(ann, card["assignment_id"], actions=[None] * STEPS)
    overview = log_in(service, "boss", "admin").get("/api/admin/overview").json()
    (row,) = (one for one in overview["annotators"] if one["name"] == "ann")
    assert (overview["answered"], row["answers"]) == (1, 1)


def test_a_bundle_holds_what_was_shown(service: Service, ann: TestClient, tmp_path: Path) -> None:
    for card in ask_for(ann, 3):
        show(ann, card["assignment_id"], actions=[[0.5, 0.5]] * STEPS)
    export_bundle(service.store, tmp_path / "bundle")
    with Store[Segment](tmp_path / "copy") as copy:
        import_bundle(tmp_path / "bundle", copy)
        assert {one.like.id for one in copy.demonstrations()} == {o.like.id for o in service.store.demonstrations()}


def test_a_full_disk_takes_nothing_and_says_so(
    service: Service, ann: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    (card,) = ask_for(ann)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patch:
        patch.setattr("prefrl.storage.events.write_arrays", full)
        assert show(ann, card["assignment_id"], actions=[[1.0, 1.0]] * STEPS).status_code == 507
    assert service.store.answers() == []
    assert show(ann, card["assignment_id"], actions=[[1.0, 1.0]] * STEPS).status_code == 200


# --- texts ---------------------------------------------------------------------------------------------------------


def test_a_rewritten_response_is_better_than_the_one_it_was_made_of(texts: Service) -> None:
    ann = log_in(texts, "ann")
    (card,) = ask_for(ann)
    assert show(ann, card["assignment_id"], text=" as it should be").status_code == 200
    (one,) = texts.store.demonstrations()
    assert (one.like.text, one.like.prompt) == (" as it should be", card["prompt"])
    assert (one.like.prompt_tokens, one.like.tokens) == ((1, 2), (0, 1, 2, 3, 9))
    implied = one.implied(1.0)
    assert implied is not None
    better = implied.query.candidates[0 if implied.judgement.preference == 1.0 else 1]  # type: ignore[union-attr]
    assert better.text == " as it should be"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (" as it was", "nothing was changed"),
        ("", "empty"),
        (" \n ", "empty"),
        ("one two three four five six", "too long: it has 7 tokens, and 6 is the most"),
        ("x" * 50_001, "50000"),
    ],
)
def test_a_text_that_says_nothing_new_or_too_much_is_refused(texts: Service, text: str, said: str) -> None:
    ann = log_in(texts, "ann")
    (card,) = ask_for(ann)
    answer = show(ann, card["assignment_id"], text=text)
    assert (answer.status_code, said in answer.json()["error"]) == (422, True), answer.text
    assert texts.store.answers() == []


def test_how_long_a_draft_is_can_be_asked_and_stores_nothing(texts: Service) -> None:
    ann, bob = log_in(texts, "ann"), log_in(texts, "bob")
    (card,) = ask_for(ann)
    before = texts.store.sequence

    def draft(client: TestClient, text: str) -> Any:
        return client.post("/api/drafts", json={"assignment_id": card["assignment_id"], "shown": {"text": text}})

    assert draft(ann, "a b c").json() == {"length": 4, "longest": 6, "fault": ""}
    long = draft(ann, "a b c d e f g").json()
    assert (long["length"], "too long" in long["fault"]) == (8, True)
    assert draft(bob, "a b c").status_code == 409
    assert texts.store.sequence == before


def test_a_program_elsewhere_asks_for_no_comparisons_where_texts_are_rewritten(texts: Service) -> None:
    trainer = browser(texts)
    trainer.headers["authorization"] = f"Bearer {invite(texts, 'program', 'trainer')}"
    body = {"queries": [{"prompt": "p", "responses": ["a", "b"]}]}
    assert trainer.put("/api/queries", json=body).status_code == 409


# --- settings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "changes", "said"),
    [
        ("text/toy", ["labeler.ask=action"], "labeler.ask=action"),
        ("control/toy", ["labeler.ask=rewrite"], "labeler.ask=rewrite"),
        ("control/toy", ["labeler.ask=action"], "select.candidates=2"),
        ("text/toy", ["labeler.ask=rewrite"], "select.candidates"),
        ("control/toy", ["select.kind=uniform", "select.candidates=1"], "select.candidates=1"),
        ("control/toy", ["labeler.ask=show"], "labeler.ask"),
    ],
)
def test_settings_that_do_not_go_together_are_refused_before_anybody_is_asked(
    store: Store[Any], preset: str, changes: list[str], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        Config.load(preset, ["labeler.kind=web", *changes]).build(store)


@pytest.mark.parametrize(("ask", "size"), [("action", 2), ("judge", 1)])
def test_a_store_that_asks_for_something_else_is_not_served(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], ask: str, size: int
) -> None:
    store.ask([make_query(0.0, 1.0) if size == 2 else Query((clip(0),))])
    labeler = WebSettings.model_validate({"ask": ask, "port": 0}).build(PointSettings().build())
    with pytest.raises(ConfigError, match=f"labeler[.]ask={ask}"):
        labeler.open(store)


def test_what_people_showed_is_cloned(service: Service, ann: TestClient) -> None:
    for card in ask_for(ann, 5):
        show(ann, card["assignment_id"], actions=[[0.5, -0.5]] * STEPS)
    rng = np.random.default_rng(0)
    task = PointSettings(segment_steps=STEPS).build()
    learner = CloneSettings(cloning_epochs=60, evaluation_episodes=1).build(task, rng)
    reward = MLPSettings(hidden=(4,)).build(task, rng)
    losses = [learner.improve(reward, service.store, rng)["cloning_loss"] for _ in range(3)]
    assert losses[2] < losses[0] / 2, losses
