"""The list of mutants cannot rot: each still fits its file. That tests notice them takes `make mutants`."""

from __future__ import annotations

import ast
from collections import Counter

import pytest
from mutate import MOST_SURVIVORS, ROOT, Mutant, mutated, read

MUTANTS = read()


def test_there_are_many_mutants_and_each_has_a_name_of_its_own() -> None:
    assert len(MUTANTS) >= 40 * MOST_SURVIVORS
    assert not [name for name, count in Counter(one.name for one in MUTANTS).items() if count > 1]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda one: one.name)
def test_a_mutant_fits_its_file_and_names_tests_that_are_there(mutant: Mutant) -> None:
    text = (ROOT / mutant.file).read_text("utf-8")
    broken = mutated(text, mutant)
    assert broken != text
    ast.parse(broken)  # Python still
    for test in mutant.tests:
        file, _, name = test.partition("::")
        assert (ROOT / file).exists(), test
        assert name in (ROOT / file).read_text("utf-8"), test
