"""Where numbers come from: the commit of the package's own checkout, and every process that had a part in a run."""

import shutil
import subprocess
from pathlib import Path

import pytest

from prefrl.evaluate.provenance import checkout, made_with
from prefrl.evaluate.summary import Origin, read_summary

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(root: Path, *words: str) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "core.excludesFile=")
    done = subprocess.run(["git", "-C", str(root), *who, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with a linked folder beside it, as ours."""
    for name in ("package", "settings"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "there.txt").write_text(name)
    (tmp_path / "package" / "settings").symlink_to("../settings")
    return tmp_path / "package"


@needs_git
def test_a_checkout_has_a_commit_and_is_changed_where_the_package_or_what_it_links_to_is(package: Path) -> None:
    root = package.parent
    assert checkout(package) == (None, None)
    git(root, "init", "-q")
    assert checkout(package) == (None, None)
    git(root, "add", "package", "settings")
    git(root, "commit", "-q", "-m", "first")
    commit = git(root, "rev-parse", "HEAD")
    (root / "notes.md").write_text("changes no result")
    assert checkout(package) == (commit, False)
    (root / "settings" / "there.txt").write_text("others")
    assert checkout(package) == (commit, True)
    git(root, "checkout", "-q", "settings")
    (package / "new.py").write_text("")
    assert checkout(package) == (commit, True)


@needs_git
def test_a_package_that_merely_lies_in_a_checkout_of_something_else_has_no_commit(package: Path) -> None:
    git(package.parent, "init", "-q")
    git(package.parent, "add", "settings")
    git(package.parent, "commit", "-q", "-m", "something else")
    assert checkout(package) == (None, None)


def test_what_a_run_is_made_with_names_no_host_no_person_and_no_folder() -> None:
    found = made_with(3)
    assert found["threads"] == 3
    assert set(found) == {
        "commit", "changed", "processor", "instructions", "gpu", "cores", "threads", "ranks", "versions",
    }  # fmt: skip


def test_every_process_that_had_a_part_in_a_run_is_told_and_equal_ones_once(tmp_path: Path) -> None:
    first, second = {"commit": "a", "versions": {}}, {"commit": "b", "versions": {}}
    begun = {"source": "control/toy", "overrides": ["seed=1"], "made_with": [first], "versions": {}}
    assert Origin(None, (), [first]).after(begun) == Origin("control/toy", ["seed=1"], [first])
    assert Origin("x", (), [second]).after(begun) == Origin("x", (), [first, second])
    before = {"versions": {"prefrl": "0.0"}}  # of a version that kept no more than that
    assert Origin("x", (), [second]).after(before).made_with == [before, second]
    (tmp_path / "summary.json").write_text("{")
    assert read_summary(tmp_path) == {}
