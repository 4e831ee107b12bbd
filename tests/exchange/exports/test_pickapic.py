from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from prefrl.components import ConfigError
from prefrl.exchange.picture_rows import picture_pair
from prefrl.exchange.ports import export, import_judgements
from prefrl.judgements import Comparison, Ranking, Skip
from prefrl.stages import config_of
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Picture, Query, Response

pa = pytest.importorskip("pyarrow")
RNG = np.random.default_rng(0)
PICTURES = [Picture("a three", RNG.integers(0, 256, (8, 8), np.uint8)) for _ in range(9)]
COLOURED = [Picture("a dog", RNG.integers(0, 256, (4, 6, 3), np.uint8)) for _ in range(2)]
QUERIES = [
    Query(tuple(PICTURES[0:2])),
    Query(tuple(COLOURED)),
    Query(tuple(PICTURES[2:5])),
    Query(tuple(PICTURES[5:7])),
]


@pytest.fixture
def full(tmp_path: Path) -> Any:
    with Store[Picture](tmp_path / "full") as store:
        store.ask(QUERIES)
        first, second, third, fourth = (query.id for query in QUERIES)
        store.answer(
            [
                Comparison(first, 0.0, "ann"),
                Comparison(second, 0.5, "ann"),
                Ranking(third, (2, 0, 1), "ben"),
                Skip(fourth, "skip", "ann"),
            ]
        )
        yield store


def test_pictures_come_back_as_they_were(full: Store[Picture], tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    done = export(full, tmp_path / "pairs.parquet", "pick-a-pic")
    assert done.written == 5
    assert done.dropped["skipped query"] == 1
    rows = pq.read_table(tmp_path / "pairs.parquet").to_pylist()
    assert {row["caption"] for row in rows} == {"a three", "a dog"}
    assert rows[0]["best_image_uid"] == rows[0]["image_1_uid"] == QUERIES[0].candidates[1].id
    assert [rows[1][name] for name in ("label_0", "label_1", "best_image_uid")] == [0.5, 0.5, "tie"]
    with Store[Picture](tmp_path / "other") as other:
        assert import_judgements(tmp_path / "pairs.parquet", other).read == 5
        found = {one.query.id: one.judgement for one in other.judged()}
    assert found[QUERIES[0].id] == Comparison(QUERIES[0].id, 0.0, "ann")
    assert found[QUERIES[1].id] == Comparison(QUERIES[1].id, 0.5, "ann")
    assert len(found) == 5
    assert import_judgements(tmp_path / "pairs.parquet", full).known == 2  # those of the ranking are new


def test_texts_do_not_fit_and_pictures_fit_no_form_for_texts(full: Store[Picture], tmp_path: Path) -> None:
    with pytest.raises(
        StoreError, match="judgements of pictures do not fit the form 'csv'; use --form bundle or pick-a-pic"
    ):
        export(full, tmp_path / "x.csv", "csv")
    with Store[Response](tmp_path / "texts") as store:
        query = Query((Response("p", "a"), Response("p", "b")))
        store.ask([query])
        store.answer([Comparison(query.id, 1.0, "ann")])
        with pytest.raises(StoreError, match="'pick-a-pic' is for pictures"):
            export(store, tmp_path / "out.parquet", "pick-a-pic")
    assert not (tmp_path / "out.parquet").exists()


def png(pixels: np.ndarray, form: str = "PNG") -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, form)
    return data.getvalue()


def row(**changes: Any) -> dict[str, Any]:
    first, second = (png(one.pixels) for one in PICTURES[:2])
    return {"caption": "a three", "jpg_0": first, "jpg_1": second, "label_0": 1, "label_1": 0, "user_id": 7, **changes}


def test_rows_of_others_are_read() -> None:
    (found,) = picture_pair(row(has_label=True, best_image_uid="somebody's"))
    assert not isinstance(found, str)
    assert isinstance(found.answer, Comparison)
    first = found.query.candidates.index(next(c for c in found.query.candidates if c.id == PICTURES[0].id))
    assert (found.answer.preference, found.answer.labeler) == (1.0 if first == 0 else 0.0, "7")
    (jpeg,) = picture_pair(row(jpg_0=png(COLOURED[0].pixels, "JPEG")))
    assert not isinstance(jpeg, str)
    assert (4, 6, 3) in {one.pixels.shape for one in jpeg.query.candidates}
    assert picture_pair(row(has_label=False)) == ["pair without a label"]
    assert picture_pair(row(jpg_1=png(PICTURES[0].pixels))) == ["pair of equal pictures"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"caption": None}, "column 'caption': expected text, got None"),
        ({"jpg_0": None}, "column 'jpg_0': expected the bytes of a picture"),
        ({"jpg_1": b"no picture"}, "column 'jpg_1': no picture that can be opened"),
        ({"jpg_1": png(np.zeros((1, 5000), np.uint8))}, "at most 4096 a side"),
        ({"label_0": 0.7, "label_1": 0.7}, "two numbers from 0 on that add up to 1"),
        ({"label_0": None}, "two numbers from 0 on"),
        ({"label_0": 2.0, "label_1": -1.0}, "two numbers from 0 on"),
        ({"label_0": True, "label_1": False}, "two numbers from 0 on"),
    ],
)
def test_rows_that_cannot_be_believed_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        picture_pair(row(**changes))


def test_a_file_of_pictures_is_told_which_settings_fit(full: Store[Picture], tmp_path: Path) -> None:
    export(full, tmp_path / "pairs.parquet", "pick-a-pic")
    (tmp_path / "texts.jsonl").write_text('{"prompt": "p", "chosen": "a", "rejected": "b"}\n')
    (tmp_path / "broken.parquet").write_bytes(b"none")
    names = {"pairs.parquet": "pictures/digits", "texts.jsonl": "text/replies", "broken.parquet": "text/replies"}
    for name, preset in names.items():
        with pytest.raises(ConfigError, match=f"--config {preset} say"):
            config_of(tmp_path / name, None)
