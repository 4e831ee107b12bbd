"""Draws the figures of the pages on methods from the tables beside this file: `python docs/curves/draw.py`."""

import csv
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

HERE = Path(__file__).parent
INK, GREY = "#1f5fa8", "0.8"
TEXT = {
    "rloo": ("RLOO", "GRPO", "RLOO, worst of three"),
    "ppo": ("PPO",),
    "online_dpo": ("online DPO",),
    "raft": ("RAFT",),
    "dpo": ("DPO",),
    "kto": ("KTO",),
    "sft": ("SFT",),
}
"""Figure -> learners of `text_frontier.csv` that it is about; the others are grey."""
CONTROL = {
    "ppo_control": ("PPO",),
    "pebble": ("PEBBLE", "PPO"),
    "memory": ("GRU without velocities", "PPO"),
}
"""Figure -> methods of `control_methods.csv`."""
TASKS = ("control/hopper", "control/cartpole", "control/pendulum", "text/reviews")
ASKED = {"information+k_medoids": "by disagreement", "uniform": "uniform"}
STYLES = ("-", "--", "-.")


def main() -> None:
    matplotlib.rcParams |= {"svg.hashsalt": "prefrl", "svg.fonttype": "none", "font.size": 9}
    for name, ours in TEXT.items():
        save(of_text(read("text_frontier"), ours), name)
    for name, ours in CONTROL.items():
        save(of_control(read("control_methods"), ours), name)
    save(of_shares(read("control_offline")), "offline")
    save(of_questions(read("reward_selection")), "selection")


def read(name: str) -> list[dict[str, str]]:
    with (HERE / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def save(figure: Figure, name: str) -> None:
    figure.savefig(HERE / f"{name}.svg", metadata={"Date": None}, facecolor="white")


def panels(labels: tuple[str, ...], x: str) -> tuple[Figure, list]:
    figure = Figure(figsize=(4 * len(labels), 2.8), layout="constrained")
    axes = list(figure.subplots(1, len(labels), squeeze=False)[0])
    for ax, label in zip(axes, labels, strict=True):
        ax.set(xlabel=x, ylabel=label)
        ax.grid(color="0.93")
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def of_text(rows: list[dict[str, str]], ours: tuple[str, ...]) -> Figure:
    """Gold and fluency over the KL: this method in colour, best-of-n dashed, all others in grey."""
    figure, axes = panels(("gold", "fluency"), "KL to the start, nats a response")
    for ax, measure in zip(axes, ("gold", "fluency"), strict=True):
        ax.set_ylim(0, 1)
        for name in dict.fromkeys(row["learner"] for row in rows):
            own = [row for row in rows if row["learner"] == name]
            at = [float(row["kl"]) for row in own], [float(row[measure]) for row in own]
            if name in ours:
                ax.plot(*at, STYLES[ours.index(name)], marker="o", markersize=4, color=INK, label=name, zorder=3)
            elif name == "best-of-n":
                ax.plot(*at, ":", color="0.35", label=name)
            else:
                ax.plot(*at, color=GREY, linewidth=1)
    axes[1].legend(frameon=False, loc="lower left")
    return figure


def of_control(rows: list[dict[str, str]], ours: tuple[str, ...]) -> Figure:
    """Gold over steps and over labels, a line for each seed."""
    measures = {"steps": "environment steps", "labels": "labels"}
    figure, axes = panels(("gold", "gold"), "")
    for ax, (measure, label) in zip(axes, measures.items(), strict=True):
        ax.set_xlabel(label)
        for name in ours:
            color = INK if name == ours[0] else "0.55"
            for seed in sorted({row["seed"] for row in rows if row["method"] == name}):
                own = [row for row in rows if (row["method"], row["seed"]) == (name, seed)]
                at = [float(row[measure]) for row in own], [float(row["gold"]) for row in own]
                ax.plot(*at, STYLES[ours.index(name)], color=color, label=f"{name}, seed {seed}")
    axes[1].legend(frameon=False, loc="lower right", fontsize=7)
    return figure


def of_shares(rows: list[dict[str, str]]) -> Figure:
    """How far each method came, a dot for each seed."""
    figure, (ax,) = panels(("share of the way",), "")
    figure.set_size_inches(4.5, 2.2)
    ax.set(xlim=(0, 1), ylabel="", xlabel="from the starting policy (0) to the run's last one (1)")
    ax.plot([float(row["share"]) for row in rows], [row["method"] for row in rows], "o", color=INK)
    ax.margins(y=0.3)
    return figure


def of_questions(rows: list[dict[str, str]]) -> Figure:
    """Accuracy on fresh pairs over labels, means over seeds, a panel for each task."""
    figure, axes = panels(TASKS, "labels")
    figure.set_size_inches(10, 2.5)
    for ax, task in zip(axes, TASKS, strict=True):
        ax.set(title=task, ylabel="")
        for (name, said), style, color in zip(ASKED.items(), STYLES, (INK, "0.45"), strict=False):
            own = [row for row in rows if (row["task"], row["selector"]) == (task, name)]
            at = sorted({int(row["labels"]) for row in own})
            found = [[float(row["accuracy"]) for row in own if int(row["labels"]) == labels] for labels in at]
            ax.plot(at, [sum(values) / len(values) for values in found], style, color=color, label=said)
    axes[0].set_ylabel("accuracy on fresh pairs")
    axes[0].legend(frameon=False, loc="lower right")
    return figure


if __name__ == "__main__":
    main()
