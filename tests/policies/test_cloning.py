"""A starting policy is cloned once, kept, and made anew where it is damaged."""

from __future__ import annotations

import hashlib
import io
import json
import re
from pathlib import Path
from typing import cast

import pytest
import torch
from pydantic import ValidationError
from rich.console import Console

from prefrl.envs.reviews import reviews, source
from prefrl.envs.text import SHIPPED, ReviewsSettings
from prefrl.policies.cloning import CloningSettings, progress
from prefrl.storage.files import verify

REVIEWS = reviews()
TINY = {"layers": 1, "width": 16, "heads": 2, "vocabulary": 400, "reviews": 128, "batch_size": 32}


def tiny(cache: Path, **changes: object) -> CloningSettings:
    return CloningSettings.model_validate({**TINY, "cache": cache, **changes})


def folder_bytes(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.glob("*/*"))}


def test_a_model_is_cloned_once_and_then_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    settings = ReviewsSettings(cloning=tiny(tmp_path))
    settings.build()
    assert "cloning the grammar" in capfd.readouterr().err
    before = folder_bytes(tmp_path)
    settings.build()
    assert capfd.readouterr().err == ""
    assert folder_bytes(tmp_path) == before
    assert {name.rsplit(".", 1)[-1] for name in before} == {"json", "safetensors"}


def test_progress_is_a_bar_on_a_terminal_and_ten_lines_elsewhere_each_with_a_rate() -> None:
    shown = {}
    for terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
        with progress(30, console) as report:
            for _ in range(30):
                report.advance(1.5)
        shown[terminal] = cast("io.StringIO", console.file).getvalue()
    assert "30/30" in shown[True]
    assert "steps/s, loss 1.50" in shown[True]
    assert shown[False].count("\n") == 11
    assert re.search(r"30 of 30 steps, [\d.]+ steps/s, loss 1.50, 0 s left", shown[False])


def test_cloning_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        tiny(tmp_path / name).build(REVIEWS.sample, source())
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")


@pytest.mark.parametrize("damage", ["model.safetensors", "tokenizer.json", "MANIFEST.json"])
def test_a_damaged_copy_is_made_anew_and_said(tmp_path: Path, damage: str, capfd: pytest.CaptureFixture[str]) -> None:
    tiny(tmp_path).build(REVIEWS.sample, source())
    before = folder_bytes(tmp_path)
    (file,) = tmp_path.glob(f"*/{damage}")
    file.write_bytes(file.read_bytes()[:-9])
    tiny(tmp_path).build(REVIEWS.sample, source())
    assert "damaged" in capfd.readouterr().err
    assert folder_bytes(tmp_path) == before


def test_another_size_seed_or_grammar_is_another_model_and_the_folder_is_not_part_of_it(tmp_path: Path) -> None:
    digests = {
        tiny(tmp_path).digest("a"),
        tiny(tmp_path, width=32).digest("a"),
        tiny(tmp_path, seed=1).digest("a"),
        tiny(tmp_path).digest("b"),
    }
    assert len(digests) == 4
    assert tiny(tmp_path).digest("a") == tiny(tmp_path / "elsewhere").digest("a")


def test_a_width_that_cannot_be_split_into_heads_is_an_error() -> None:
    with pytest.raises(ValidationError, match="multiple of 2 x heads"):
        CloningSettings(width=100, heads=8)


def test_what_is_shipped_was_made_by_todays_recipe_and_is_whole() -> None:
    """Else `python benchmarks/start_reviews.py` has not been run since."""
    recipe = json.loads((SHIPPED / "RECIPE.json").read_text())
    assert recipe == CloningSettings().recipe(source())
    verify(SHIPPED)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 2.1e6


def test_default_settings_need_no_cloning_and_others_do(tmp_path: Path) -> None:
    task = ReviewsSettings(cloning=CloningSettings(cache=tmp_path)).build()
    assert not list(tmp_path.iterdir())
    assert task.model().dtype == torch.float32
    said = "".join(str(task.tokenizer.decode(list(task.encode("I read this book.")))).split())
    assert said.endswith("Ireadthisbook.")
    small = tiny(tmp_path, reviews=64).build(reviews().sample, source(), SHIPPED)
    assert len(list(tmp_path.iterdir())) == 1
    assert small[0].config.hidden_size != task.model().config.hidden_size


def test_shipping_writes_the_same_model_in_half_precision(tmp_path: Path) -> None:
    settings = tiny(tmp_path / "cache")
    settings.ship(reviews().sample, source(), tmp_path / "shipped")
    made, _ = settings.build(reviews().sample, source())
    loaded, tokenizer = settings.build(reviews().sample, source(), tmp_path / "shipped")
    assert loaded.dtype == torch.float32
    for one, other in zip(loaded.parameters(), made.parameters(), strict=True):
        assert torch.equal(one, other.half().float())
    assert tokenizer.encode("A film.") == settings.build(reviews().sample, source())[1].encode("A film.")
