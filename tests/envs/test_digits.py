from __future__ import annotations

import math
from typing import cast

import numpy as np
import pytest
from small_pictures import small_digits

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.digits import CAPTIONS, DIGITS, DigitsSettings, flat, real_digits
from prefrl.protocols import pictures
from prefrl.store import Store
from prefrl.types import Picture

PIXELS, WHICH = real_digits()
HALF = len(PIXELS) // 2


def real(caption: str, digit: int, start: int = 1) -> list[Picture]:
    """Of the half that the gold's classifier has not seen."""
    return [Picture(caption, one) for one in PIXELS[start::2][WHICH[start::2] == digit]]


def test_the_gold_of_a_digit_is_what_a_classifier_reads_of_it() -> None:
    task = small_digits("a three", "an eight")
    right, wrong = task.gold(real("a three", 3)), task.gold(real("a three", 8))
    assert (right > 0.5).mean() > 0.9
    assert (wrong < 0.5).mean() > 0.9
    assert (task.gold(real("an eight", 8)) > 0.5).mean() > 0.85
    mixed = [real("a three", 3)[0], real("an eight", 3)[0]]
    assert task.gold(mixed).round(3).tolist() == [task.gold(mixed[:1])[0].round(3), task.gold(mixed[1:])[0].round(3)]


def test_ink_is_a_gold_and_what_only_you_can_tell_has_none() -> None:
    task = small_digits("thicker", "mine")
    black, full = np.zeros((8, 8), np.uint8), np.full((8, 8), 255, np.uint8)
    found = task.gold([Picture("thicker", black), Picture("thicker", full), Picture("mine", full)])
    assert found[:2].tolist() == [0.0, 1.0]
    assert math.isnan(found[2])


def test_an_independent_reader_shares_no_picture_with_the_gold() -> None:
    task, half = small_digits(), PIXELS[0::2]
    found = task.reader().predict(half.reshape(-1, 64) / 255)  # the gold's half, which is new to it
    assert 0.97 < (found == WHICH[0::2]).mean() < 1.0


def test_the_spread_of_real_digits_is_one_and_that_of_one_picture_none() -> None:
    task = small_digits("a three", "an eight", "thicker")
    threes = real("a three", 3, 0) + real("a three", 3)
    assert task.spread(threes) == pytest.approx(1.0)
    assert task.spread(threes[:1] * 5) == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(task.spread(threes[:1]))
    assert task.spread([Picture("thicker", one) for one in PIXELS]) == pytest.approx(1.0)
    both = threes + real("an eight", 8)[:1] * 2
    assert task.spread(both) == pytest.approx(0.5)


def test_a_picture_is_shown_large_and_dark_on_light() -> None:
    task, pixels = small_digits(), np.zeros((8, 8), np.uint8)
    pixels[0, 7] = 255
    (frame,) = task.frames(Picture("a three", pixels))
    assert frame.shape == (160, 160, 3)
    assert frame[0, -1].tolist() == [0, 0, 0]
    assert frame[-1, 0].tolist() == [255, 255, 255]
    assert (frame[:20, -20:] == 0).all()
    with pytest.raises(ValueError, match=r"has pixels of shape \(4, 4\); expected \(8, 8\)"):
        task.frames(Picture("a three", np.zeros((4, 4), np.uint8)))


def test_a_caption_that_is_unknown_is_refused_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"task.captions: unknown caption 'a thre'; did you mean 'a three'\?"):
        Config.load("pictures/digits", ["task.captions=[a thre]"])
    with pytest.raises(ConfigError, match="expected captions that differ"):
        Config.load("pictures/digits", ["task.captions=[mine, mine]"])
    assert len(CAPTIONS) == len(DIGITS) + 2
    assert DIGITS["an eight"] == 8


def test_a_task_of_another_kind_is_refused() -> None:
    task = small_digits()
    assert pictures(task, "a learner") is task
    with pytest.raises(ConfigError, match="learner kind 'text' writes text, but the task is of kind 'pictures'"):
        Config.load("pictures/digits", ["learner.kind=text"]).build_learner(task, np.random.default_rng(0))
    config, other = Config.load("control/toy", ["learner.kind=pictures"]), Config.load("control/toy").build_task()
    with pytest.raises(ConfigError, match="draws pictures, but the task is of kind 'control'"):
        config.build_learner(other, np.random.default_rng(0))


def test_a_reward_model_hangs_on_the_captions_and_not_on_the_start() -> None:
    one = DigitsSettings()
    assert one.identity() == one.shrunk().identity()
    assert one.identity() != DigitsSettings(captions=("a two",)).identity()
    assert flat(real("a three", 3)[:2]).shape == (2, 64)


@pytest.mark.parametrize("labeler", ["labeler.kind=oracle", "labeler={kind: crowd, annotators: [{name: ann}]}"])
def test_who_goes_by_gold_is_not_asked_about_what_has_none(labeler: str) -> None:
    config = Config.load("pictures/digits", ["task.captions=[a three, mine]", labeler])
    shrunk = config.model_copy(update={"task": config.task.shrunk()})
    none = cast("Store[Picture]", None)
    with pytest.raises(
        ConfigError, match=r"goes by gold, and there is none for the caption mine: set labeler.kind=web"
    ):
        shrunk.build(none)
    shrunk.model_copy(update={"loop": shrunk.loop.model_copy(update={"labels": 0})}).build(none)
