"""Bring the tables of an older prefrl up to date, after a backup."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path

import sqlalchemy as sql

from prefrl.storage.files import make_folder, sync_folder
from prefrl.storage.projection import rebuild


def migrate(writer: sql.Engine, folder: Path) -> None:
    """Run the migrations that are missing, in one transaction; a copy of the database is made first.

    A process that is killed here leaves the old tables, or the new ones, and in either case the copy.
    """
    _back_up(writer, folder)
    from alembic import command
    from alembic.config import Config

    with writer.begin() as connection:
        config = Config(attributes={"connection": connection})
        config.set_main_option("script_location", str(files("prefrl.storage") / "migrations"))
        if not sql.inspect(connection).has_table("alembic_version"):
            command.stamp(config, "1")
        command.upgrade(config, "head")
        rebuild(connection)


def _back_up(writer: sql.Engine, folder: Path) -> None:
    """A copy of an SQLite database, in `backups/`. For other databases this is their server's business."""
    if writer.dialect.name != "sqlite":
        return
    make_folder(folder / "backups")
    to = folder / "backups" / f"store-{datetime.now(UTC):%Y%m%dT%H%M%S%f}.db"
    with writer.connect() as connection:
        raw = connection.connection.driver_connection  # VACUUM cannot run within a transaction
        assert raw is not None
        raw.execute("VACUUM INTO ?", (str(to),))
    sync_folder(folder / "backups")
