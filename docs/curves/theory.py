"""Draws the maps of docs/theory.md, all of them exact: `python docs/curves/theory.py`."""

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from prefrl.envs import exact
from prefrl.envs.tabular import MOVES, WALL, Grid, GridworldSettings

HERE = Path(__file__).parent
WORLD = GridworldSettings().world()
INK = "0.15"


def main() -> None:
    matplotlib.rcParams |= {"svg.hashsalt": "prefrl", "svg.fonttype": "none", "font.size": 9}
    mdp = WORLD.mdp
    states, actions = mdp.rewards.shape
    uniform = np.full((states, actions), 1 / actions)
    over_time = exact.marginals(replace(mdp, start=np.eye(states)[0]), uniform, 31).sum(2)
    shares = {f"t = {t}": over_time[t] for t in (1, 5, 30)} | {"for ever": exact.stationary(mdp, uniform).sum(1)}
    save(maps(shares, "Blues", {}), "theory_chain")

    values, policies = {}, {}
    policy = uniform
    for name in ("random", "one step better", "two steps better"):
        found = exact.action_values(mdp, policy)
        values[name] = exact.state_values(policy, found)
        if name != "random":
            policies[name] = policy
        policy = exact.greedy(found)
    best, found = exact.policy_iteration(mdp)
    save(maps(values | {"best": found.max(1)}, "RdYlBu", policies | {"best": best}), "theory_improvement")


def maps(panels: dict[str, np.ndarray], colours: str, policies: dict[str, np.ndarray]) -> Figure:
    """A map for each panel, of a number for each state; arrows where there is a policy."""
    assert WORLD.grid is not None
    figure = Figure(figsize=(2.6 * len(panels), 2.3), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (name, values) in zip(axes, panels.items(), strict=True):
        top = 1.6 * np.abs(values).max()  # the far ends of these colours are too dark to write on
        ax.imshow(WORLD.grid.spread(values), cmap=colours, vmin=0 if colours == "Blues" else -top, vmax=top)
        ax.set_title(name, fontsize=10)
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_facecolor("0.3")
        numbers(ax, WORLD.grid, values, policies.get(name))
    return figure


def numbers(ax: Axes, grid: Grid, values: np.ndarray, policy: np.ndarray | None) -> None:
    for (i, j), number in grid.cells.items():
        kind = grid.rows[i][j]
        assert kind != WALL
        mark = f"{values[number]:.2f}" if np.abs(values).max() < 1 else f"{values[number]:.1f}"
        ax.text(j, i + (0.25 if policy is not None else 0), mark, ha="center", va="center", fontsize=7, color=INK)
        if kind in "Gx":
            ax.text(j - 0.45, i - 0.28, kind, fontsize=7, color=INK, fontweight="bold")
        elif policy is not None:
            down, right = MOVES[int(policy[number].argmax())]
            arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1}
            tail, head = (j - 0.22 * right, i - 0.14 - 0.2 * down), (j + 0.22 * right, i - 0.14 + 0.2 * down)
            ax.annotate("", head, tail, arrowprops=arrow)


def save(figure: Figure, name: str) -> None:
    figure.savefig(HERE / f"{name}.svg", metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
