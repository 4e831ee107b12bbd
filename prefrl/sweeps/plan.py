"""The runs of a sweep: presets, a grid of settings, seeds."""

from __future__ import annotations

import re
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import Field, ValidationError, field_validator

from prefrl.components import ConfigError, Settings
from prefrl.config import Config, read_settings
from prefrl.mistakes import explained, placed


class Member(NamedTuple):
    """One run of a sweep."""

    name: str
    """Of its folder, within the sweep's."""
    source: str
    """A preset or a YAML file."""
    overrides: tuple[str, ...]
    """Its seed among them."""


class SweepPlan(Settings):
    """Every preset, with every combination of the grid's values, for every seed."""

    presets: tuple[str, ...] = Field(min_length=1)
    """Presets or YAML files; these are taken from the working directory where they are relative."""
    seeds: int = Field(5, ge=1)
    """How many runs of each."""
    first: int = Field(0, ge=0)
    """The first seed; the others follow it."""
    set: tuple[str, ...] = ()
    """Settings of all runs, as `dotted.key=value`."""
    grid: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field({})
    """Settings and the values that they take: all combinations are run."""

    @field_validator("set", "grid")
    @classmethod
    def _leaves_the_seeds_alone(cls, given: Any) -> Any:
        if any(one.partition("=")[0] == "seed" for one in given):
            raise ValueError("seed: set it with `first` and `seeds`")
        return given

    @classmethod
    def load(cls, path: Path) -> SweepPlan:
        """Read a YAML file. Raises `ConfigError`."""
        try:
            return cls.model_validate(read_settings(path))
        except ValidationError as error:
            lines = (placed(line.removeprefix("."), path, ()) for line in explained(cls, error.errors()))
            raise ConfigError("\n".join(lines)) from None

    def members(self) -> list[Member]:
        """All runs, the seeds of one variant after another's.

        The settings of each are built, so that a mistake is reported before anything starts. Raises `ConfigError`.
        """
        found = []
        for source, values in product(self.presets, product(*self.grid.values())):
            chosen = [f"{key}={_written(value)}" for key, value in zip(self.grid, values, strict=True)]
            variant = ",".join([Path(source).stem if Path(source).is_file() else source.replace("/", "-"), *chosen])
            if Config.load(source, [*self.set, *chosen]).labeler.asks_people():
                raise ConfigError("labeler.kind: a sweep cannot ask people; choose oracle, crowd or judge")
            for seed in range(self.first, self.first + self.seeds):
                name = f"{_for_a_folder(variant)}/seed-{seed}"
                found.append(Member(name, source, (*self.set, *chosen, f"seed={seed}")))
        twice = [name for name, count in Counter(member.name for member in found).items() if count > 1]
        if twice:
            raise ConfigError(
                f"two runs would share the folder {twice[0]}: a value or preset is listed twice, or names are alike"
            )
        return found


def _written(value: Any) -> str:
    """A value as an override says it: YAML in one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("\n").removesuffix("\n...")


def _for_a_folder(variant: str) -> str:
    return re.sub(r"[^\w.,=+-]", "_", variant)[:200]
