"""Small candidates and stores that many tests share."""

from __future__ import annotations

import math
import signal
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import postgres_server
import pytest
import runs
import torch
from hypothesis import settings

from prefrl.config import Config
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

if TYPE_CHECKING:
    from shell import Shell

    from prefrl.envs.text import Reviews


pytest_plugins = ["budget", "pytester"]


settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")  # how long an example takes hangs on what else the machine does


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Tests compare bytes, and share two cores."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests, and the processes they start, keep starting policies in a folder of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(runs.made_once(tmp_path_factory, "cache", Path.mkdir)))
        yield


@pytest.fixture(autouse=True, scope="session")
def _warm(request: pytest.FixtureRequest, _own_cache: None) -> None:
    """Where tests are held to a budget: what they all need is there, so that none pays for it by being the first."""
    if request.config.getoption("--budget"):
        for name in (
            "torch.utils.tensorboard", "transformers.models.gpt2.modeling_gpt2", "matplotlib.pyplot",
            "stable_baselines3", "gymnasium.envs.mujoco",
        ):  # fmt: skip
            import_module(name)
        request.getfixturevalue("finished_tiny")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def make_segment(rng: np.random.Generator) -> Callable[..., Segment]:
    """Segments of random numbers, each of an episode of its own."""
    count = iter(range(10_000))

    def make(steps: int = 5, gold: float | None = None) -> Segment:
        observations = rng.normal(size=(steps, 3)).astype(np.float32)
        actions = rng.normal(size=(steps, 2)).astype(np.float32)
        hidden = None if gold is None else np.full(steps, gold / steps)
        return Segment(observations, actions, episode=str(next(count)), start=0, gold=hidden)

    return make


@pytest.fixture
def make_query(make_segment: Callable[..., Segment]) -> Callable[..., Query[Segment]]:
    """A query over new segments, with the golds given."""
    return lambda *golds: Query(tuple(make_segment(gold=g) for g in (golds or (0.0, 1.0))))


@pytest.fixture
def make_pairs(make_segment: Callable[..., Segment]) -> Callable[[int], list[Query[Segment]]]:
    """Many pairs out of few segments, which a store files in no time; one is of gold 0, the other of gold 1."""

    def make(count: int) -> list[Query[Segment]]:
        few = range(math.isqrt(count - 1) + 1)
        worse, better = ([make_segment(gold=gold) for _ in few] for gold in (0.0, 1.0))
        return [Query(pair) for pair in product(worse, better)][:count]

    return make


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store[Segment]]:
    with Store[Segment](tmp_path / "store") as opened:
        yield opened


@pytest.fixture
def text_store(tmp_path: Path) -> Iterator[Store[Response]]:
    with Store[Response](tmp_path / "text") as opened:
        yield opened


@pytest.fixture
def prefrl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Shell:
    """Runs `prefrl ...` in an empty folder."""
    from shell import Shell

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return Shell(monkeypatch, capsys)


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """The URL of a PostgreSQL server of our own; without one the test is skipped."""
    # Not below pytest's folders: they are closed to others, and root starts the server as somebody else.
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        postgres_server.running(Path(folder)) as url,
    ):
        yield url


@pytest.fixture
def postgres_url(postgres: str) -> str:
    """A new database there."""
    return postgres_server.new_database(postgres)


@pytest.fixture(scope="session")
def finished_toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of "control/toy". All tests share it: nobody may write there."""
    return runs.made_once(tmp_path_factory, "toy", lambda folder: runs.finish(Config.load("control/toy"), folder))


@pytest.fixture
def toy_run(finished_toy: Path, tmp_path: Path) -> Path:
    """A finished run of "control/toy" that a test may do with as it likes, in the folder `run`."""
    return runs.copied(finished_toy, tmp_path / "run")


@pytest.fixture(scope="session")
def finished_tiny(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The finished tiny run of each toy preset. All tests share them: nobody may write there."""
    made = {}
    for number, name in enumerate(runs.TINY):
        config = runs.tiny(name)
        made[name] = runs.made_once(tmp_path_factory, f"tiny-{number}", partial(runs.finish, config))
    return made


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where tiny starting policies are kept, once for all tests."""
    return runs.made_once(tmp_path_factory, "models", Path.mkdir)


@pytest.fixture(scope="session")
def toy_reviews(models: Path) -> Reviews:
    """The text task with a tiny starting policy, cloned once for all tests."""
    return runs.small_reviews(models)


@pytest.fixture
def heard() -> Iterator[None]:
    """Ctrl-C reaches this process and those that it starts, also where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
