"""The command that shows what a policy does: record."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np

commands = typer.Typer()


@commands.command()
def record(
    policy: Annotated[Path, typer.Argument(help="A run of control, or a zip of stable-baselines3.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="An .mp4, .webm or .gif.")] = Path("video.mp4"),
    env: Annotated[str | None, typer.Option(help="Gymnasium's id; default: the run's own task.")] = None,
    episodes: Annotated[int, typer.Option(help="How many, one after another.", min=1)] = 3,
    best: Annotated[
        bool, typer.Option("--best", help="The best policy by the newest reward, in place of the last one.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of how episodes begin.", min=0)] = 0,
) -> None:
    """Write a video of a policy's mode, and print what its episodes return."""
    import numpy as np

    from prefrl.cli.console import counted, say
    from prefrl.evaluate.film import filmed
    from prefrl.page.clips.encode import write_film
    from prefrl.stages import on_stage

    acting, task = on_stage(policy, env, best)
    returns: list[float] = []

    def clips() -> Iterator[np.ndarray]:
        taken = filmed(task, acting.act(None), episodes, np.random.default_rng(seed))
        for one in counted(taken, episodes, "episodes"):
            returns.append(one.gold)
            yield one.frames

    write_film(out, clips(), task.fps)
    for number, gold in enumerate(returns, 1):
        say(f"episode {number}: return {gold:.6g}")
    say(f"{out}: {episodes} episodes of {policy} in {task.name}, mean return {np.mean(returns):.6g}")
