"""Every command and code block of the documents runs, in an empty folder where the demo's runs lie, at toy size."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import warm
from runs import TINY, copied, made_once

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
INSTALL = {"pip install 'prefrl[label]'", "pip install '.[all]'", "source .venv/bin/activate"}
RUN_BY_CI = {"make demo", "make test", *INSTALL}
"""CI runs these by themselves, before or around the tests."""
SERVES = re.compile("--serve|labeler.kind=web")
"""Commands that wait for people; the browser's tests answer them."""


def blocks(path: Path) -> list[tuple[str, str]]:
    """(language, code) of each block that can be run."""
    return re.findall(r"^```(python|bash)\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """What commands find there: a `prefrl` that has its imports behind it, then everything that is installed."""
    with warm.commands(tmp_path_factory.mktemp("commands") / "bin") as folder:
        path = os.pathsep.join((str(folder), str(Path(sys.executable).parent), os.environ["PATH"]))
        yield os.environ | {"PATH": path, "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]) -> Path:
    """The demo's runs, made once for all."""

    def make(folder: Path) -> None:
        folder.mkdir()
        for preset, name in (("control/toy", "pendulum"), ("text/toy", "reviews")):
            run(f"prefrl run {preset} --out runs/{name}", folder, environment)

    return made_once(tmp_path_factory, "demo", make)


@pytest.fixture
def workshop(demo: Path, tmp_path: Path) -> Path:
    return copied(demo, tmp_path / "workshop")


SHORT = TINY | {
    "control/pendulum": ("loop.rounds=2", "loop.labels=20"),
    "control/pendulum-hidden": ("loop.rounds=2", "loop.labels=20", "learner.steps_per_round=4800"),
    "control/gridworld": ("loop.rounds=2", "loop.labels=20"),
}
"""Of presets that would learn for longer than a test may."""


def sped(line: str) -> str:
    """A command that runs such a preset on its own task, with what it leaves open set as low as it can be."""
    found = re.search(r"prefrl .*?\b(run|label|improve) ([a-z]+/[\w+-]+)", line)
    if found is None or found[2] not in SHORT or "task." in line:
        return line
    taken = ("learner." if "learner.kind" in line else "", *re.findall(r"[\w.]+(?==)", line))
    low = [one for one in SHORT[found[2]] if not one.startswith(tuple(filter(None, taken)))]
    return " ".join((line[: found.end()], *low)) + line[found.end() :]


def run(code: str, folder: Path, environment: dict[str, str]) -> None:
    """Run shell commands there, with somebody at the keyboard who always presses 1."""
    for line in code.splitlines():
        if SERVES.search(line):
            serve(line, folder, environment)
    code = "\n".join(line for line in code.splitlines() if not SERVES.search(line))
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", code],
        cwd=folder,
        env=environment,
        input="1\n" * 100,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"


def serve(command: str, folder: Path, environment: dict[str, str]) -> None:
    """Start a command that waits for people; once it has printed its link, interrupt it."""
    serving = subprocess.Popen(
        ["bash", "-c", f"exec {command}"], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    )
    assert serving.stdout is not None
    said = ""
    while "http://127.0.0.1" not in said:
        line = serving.stdout.readline()
        assert line, f"{command}\n{said}"
        said += line
    serving.send_signal(signal.SIGINT)
    assert serving.wait(120) == 130
    serving.stdout.close()


@pytest.mark.slow
@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_block_runs(
    path: Path, workshop: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workshop)
    for language, code in blocks(path):
        if language == "python":
            if named := re.match(r"# (\w+\.py)\n", code):  # the file that the commands after it speak of
                (workshop / named[1]).write_text(code)
            exec(compile(code, str(path), "exec"), {"__name__": "__main__"})
        else:
            lines = [line for line in code.splitlines() if line.split("#")[0].strip() not in RUN_BY_CI]
            run("\n".join(map(sped, lines)), workshop, environment)


@pytest.mark.slow
def test_every_logged_number_is_explained(demo: Path) -> None:
    explained = (ROOT / "docs/metrics.md").read_text()
    for path in demo.glob("runs/*/metrics.jsonl"):
        for key in {key for line in path.read_text().splitlines() for key in json.loads(line)}:
            assert f"`{key.removesuffix('_held_out')}`" in explained, f"{key} is missing in docs/metrics.md"


def test_links_between_documents_lead_somewhere() -> None:
    for path in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#:]+)\)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name} links to {target}"
