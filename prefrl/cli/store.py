"""Commands that care for a store: verify, backup, migrate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

commands = typer.Typer()
Folder = Annotated[Path, typer.Argument(help="A run, or another folder with a store.", exists=True, file_okay=False)]


@commands.command()
def verify(
    folder: Folder,
    repair_derived: Annotated[
        bool, typer.Option("--repair-derived", help="Write the derived tables again from the log.")
    ] = False,
    salvage: Annotated[
        Path | None, typer.Option(help="Copy what is whole of a damaged store into this new folder.")
    ] = None,
) -> None:
    """Check a store: its database, its chain of hashes, what is derived from it, its files."""
    from prefrl.cli.console import say
    from prefrl.storage import maintenance

    if salvage is not None:
        found = maintenance.salvage(folder, salvage)
        say(f"{found.whole} events saved into {salvage}" + (f"; then: {found.faults[0]}" if found.faults else ""))
        return
    if repair_derived:
        maintenance.repair_derived(folder)
    found = maintenance.verify_store(folder)
    for fault in found.faults:
        say(fault, "red")
    if found.ok:
        say(f"whole: {found.events} events, {found.blobs} candidates, chain ends in {found.hash[:16]}", "green")
        return
    say(f"the log is whole up to event {found.whole}")
    raise typer.Exit(1)


@commands.command()
def backup(
    folder: Folder, to: Annotated[Path, typer.Option(help="The new folder that gets the copy.", show_default=False)]
) -> None:
    """Copy a store, also while people label, and check the copy."""
    from prefrl.cli.console import say
    from prefrl.storage.maintenance import backup as back_up

    say(f"{back_up(folder, to)} events copied into {to}")


@commands.command()
def migrate(folder: Folder) -> None:
    """Bring a store that an older prefrl made up to date; a copy of its database is kept in backups/."""
    from prefrl.cli.console import say
    from prefrl.storage.log import EventLog, require_store
    from prefrl.storage.tables import SCHEMA

    require_store(folder)
    EventLog(folder, write=True).close()
    say(f"{folder} has schema {SCHEMA}")
