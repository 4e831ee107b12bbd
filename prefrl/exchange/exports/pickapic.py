"""Pairs of pictures as Pick-a-Pic publishes them (Kirstain et al. 2023): one Parquet file, a pair a row."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from prefrl.exchange.exports.dataset import write_table
from prefrl.exchange.exports.given import LABELER, STRENGTH, TIME, Exported, Tally, each_answer, whole_file
from prefrl.judgements import implied_pairs
from prefrl.kinds import only
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Json, Picture


def export_pickapic(store: Store, path: Path) -> Exported:
    """Write every pair that the judgements imply. Raises `StoreError` for candidates that are no pictures.

    The columns `jpg_0` and `jpg_1` hold PNG, which loses nothing; whoever opens them with Pillow does not notice.
    """
    tally = Tally({LABELER, STRENGTH, TIME})
    with whole_file(path) as file:
        written = write_table(file, _rows(store, tally), _columns())
    return tally.done(store, written, "jpg_0 and jpg_1 hold PNG, so that pictures come back as they were")


def _rows(store: Store, tally: Tally) -> Iterator[Json]:
    for number, given in enumerate(each_answer(store)):
        error = StoreError("the form 'pick-a-pic' is for pictures, and the store holds other candidates: use bundle")
        pictures = only(Picture, given.query.candidates, error)
        tally.note(given)
        if given.answer.reason is not None:
            tally.skip(given.answer.reason)
            continue
        for i, j, preference in implied_pairs(given.answer, len(pictures)):
            pair = pictures[i], pictures[j]
            yield _row(pair, preference) | {
                "created_at": given.at,
                "user_id": given.answer.labeler,
                "ranking_id": number,
                "query": given.query.id,
            }


def _row(pair: tuple[Picture, Picture], preference: float) -> Json:
    better = "tie" if preference == 0.5 else pair[0 if preference > 0.5 else 1].id
    sides = {
        f"{name}_{side}": value
        for side, one, label in zip((0, 1), pair, (preference, 1 - preference), strict=True)
        for name, value in (("jpg", _png(one)), ("label", label))
    }
    uids = {f"image_{side}_uid": one.id for side, one in enumerate(pair)}
    return (
        {"caption": pair[0].caption, "best_image_uid": better, "are_different": True, "has_label": True} | sides | uids
    )


def _png(picture: Picture) -> bytes:
    data = io.BytesIO()
    Image.fromarray(picture.pixels).save(data, "PNG")
    return data.getvalue()


def _columns() -> Any:
    import pyarrow as pa

    texts = ("caption", "image_0_uid", "image_1_uid", "best_image_uid", "created_at", "user_id", "query")
    kinds = {"jpg": pa.binary(), "label": pa.float64()}
    return pa.schema(
        [
            *((name, pa.string()) for name in texts),
            *((f"{name}_{side}", kind) for name, kind in kinds.items() for side in (0, 1)),
            *((name, pa.bool_()) for name in ("are_different", "has_label")),
            ("ranking_id", pa.int64()),
        ]
    )
