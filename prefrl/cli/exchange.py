"""Commands that move judgements: export and import."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from prefrl.exchange.layout import Layout, Which
    from prefrl.exchange.ports import Imported
    from prefrl.store import Store

commands = typer.Typer()
Out = Annotated[Path, typer.Option("--out", "-o", help="The folder that is written.")]
Labelers = Annotated[str, typer.Option(help="Only judgements by these, separated by commas; default: everybody's.")]
Split = Annotated[str, typer.Option(help="Only this part of a file, train or eval say; default: all of it.")]
SHOWN = 12
"""How many lines of a long note are printed at most."""


class Form(StrEnum):
    """What is written to files, and how; docs/interchange.md says what each one loses."""

    preferences = "preferences"
    conversational = "conversational"
    unpaired = "unpaired"
    unpaired_conversational = "unpaired-conversational"
    demonstrations = "demonstrations"
    judgements = "judgements"
    dataset = "dataset"
    argilla = "argilla"
    label_studio = "label-studio"
    arena = "arena"
    csv = "csv"
    minari = "minari"
    pick_a_pic = "pick-a-pic"
    bundle = "bundle"
    classifier = "classifier"
    policy = "policy"
    adapter = "adapter"
    sb3 = "sb3"
    onnx = "onnx"


class Ties(StrEnum):
    """What becomes of ties where a form has no place for them."""

    drop = "drop"
    both = "both"


class Rows(StrEnum):
    """How the rows of a file are laid out."""

    auto = "auto"
    preferences = "preferences"
    unpaired = "unpaired"
    demonstrations = "demonstrations"
    responses = "responses"
    tree = "tree"
    argilla = "argilla"
    label_studio = "label-studio"
    arena = "arena"
    pick_a_pic = "pick-a-pic"


MODELS = {Form.classifier: "text", Form.policy: "text", Form.adapter: "text", Form.sb3: "control", Form.onnx: "control"}
"""The forms that are models, and the kind of their candidates."""


@commands.command("export")
def export_(
    store: Annotated[
        Path, typer.Argument(help="A folder of `prefrl run`, `label` or `fit`; for onnx also a zip.", exists=True)
    ],
    to: Annotated[
        Path,
        typer.Option(
            help="A folder for dataset, minari, bundle and models, else a file; .npz for what was shown in control."
        ),
    ],
    form: Annotated[
        Form, typer.Option(help="The columns of TRL, what other tools read, all there is, or a model.")
    ] = Form.preferences,
    ties: Annotated[Ties, typer.Option(help="In the columns of TRL: leave ties out, or write them both ways.")] = (
        Ties.drop
    ),
    best: Annotated[
        bool, typer.Option("--best", help="With sb3 and onnx: the best policy, in place of the last one.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write over a file that is there.")] = False,
) -> None:
    """Write answers, a reward model of text or a policy to files, and say what these could not hold."""
    from prefrl.cli.console import say

    if best and form not in (Form.sb3, Form.onnx):
        raise ValueError(f"--best goes with --form sb3 and --form onnx: {form.value} has no best policy")
    if form is Form.sb3 and not to.suffix:
        to = to.with_suffix(".zip")  # as stable-baselines3 does
    if to.is_file() and not force:
        raise ValueError(f"{to} is there already: choose another name, or write over it with --force")
    if form in MODELS:
        say(_export_model(store, to, form, best))
        return
    from prefrl.exchange.ports import export
    from prefrl.store import Store

    with Store(store, write=False) as opened:
        done = export(opened, to, form.value, ties.value)
    for name, count in done.dropped.items():
        say(f"left out: {count} x {name}", "yellow")
    for note in done.notes:
        say(note, "yellow")
    if not done.written:
        raise ValueError(f"{store} holds nothing that {form.value} can say: {to} is empty")
    say(f"{done.written} written to {to}")


def _export_model(source: Path, to: Path, form: Form, best: bool) -> str:
    """Write a model and the README that goes with it; returns what to say of it."""
    from prefrl import stages
    from prefrl.report.hub import write_readme

    if form is Form.classifier:
        shift = stages.export_classifier(source, to)
        said = f"its logit, shifted by {shift:+.6g}, is the mean of the reward's members"
    elif form is Form.sb3:
        round = stages.export_sb3(source, to, best)
        said = f"the policy after round {round}; stable-baselines3 loads it, and it acts on raw observations"
        said += stages.shown_of(source)
    elif form is Form.onnx:
        stages.export_onnx(source, to, best)
        said = f"raw observations (n, O){stages.shown_of(source)} in, actions out: the policy's mode"
    else:
        stages.policy_of(source).save(to, adapter=form is Form.adapter)
        loads = "PeftModel.from_pretrained" if form is Form.adapter else "AutoModelForCausalLM.from_pretrained"
        said = f"the newest policy, with its tokenizer; {loads} reads it"
    if source.is_dir():
        write_readme(source, to, form.value, MODELS[form], best)
    return f"{to}: {said}"


@commands.command("import")
def import_(
    path: Annotated[
        Path,
        typer.Argument(help="A file of judgements or demonstrations, a data set's folder, or a bundle.", exists=True),
    ],
    labelers: Labelers = "",
    split: Split = "",
    out: Out = Path("labels"),
    form: Annotated[Rows, typer.Option(help="How its rows are laid out; auto looks at their columns.")] = Rows.auto,
    map_: Annotated[
        str, typer.Option("--map", help="Which columns are what: prompt=question,chosen=better,rejected=worse.")
    ] = "",
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave bad rows out, and name them.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything, write nothing.")] = False,
) -> None:
    """Read judgements and demonstrations from files into a store, all or none; recorded behaviour is demonstrations."""
    from prefrl.cli.console import say
    from prefrl.exchange.layout import Layout, Which

    layout = Layout.of(form.value, map_, skip_bad)
    done = (_try if dry_run else _import)(path, out, Which.of(labelers, split), layout)
    for note in done.notes:
        for line in note.splitlines()[:SHOWN]:
            say(line, "yellow")
    new = f": {done.read - done.known} new, {done.known} there already" if done.known else ""
    say(f"{done.read} answers {'would be read' if dry_run else 'read'} into {out}{new}")


def _import(path: Path, out: Path, which: Which, layout: Layout) -> Imported:
    from prefrl.exchange.ports import import_judgements

    with _store(out) as store:
        return import_judgements(path, store, which, layout)


def _try(path: Path, out: Path, which: Which, layout: Layout) -> Imported:
    from prefrl.exchange.ports import try_import
    from prefrl.storage.log import has_store
    from prefrl.store import Store

    if not has_store(out):
        return try_import(path, None, which, layout)
    with Store(out, write=False) as store:
        return try_import(path, store, which, layout)


@contextmanager
def _store(folder: Path) -> Iterator[Store]:
    """The store of a folder. One that had to be made is removed again where something fails."""
    from prefrl.storage.log import has_store
    from prefrl.store import Store

    made = [path for path in (folder, *folder.parents) if not path.exists()]
    before = set(folder.iterdir()) if folder.is_dir() else set()
    opened, new = False, not has_store(folder)
    try:
        with Store(folder) as store:
            opened = True
            yield store
    except BaseException:
        if opened and new:  # one that cannot be opened may be somebody else's
            _remove({*folder.iterdir()} - before)
            for path in made:
                path.rmdir()
        raise


def _remove(paths: set[Path]) -> None:
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
