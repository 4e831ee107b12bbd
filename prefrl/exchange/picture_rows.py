"""Judged pairs of pictures in the columns of Pick-a-Pic (Kirstain et al. 2023): a caption and two files of pictures.

`caption`, `jpg_0`, `jpg_1` (bytes of any format that Pillow opens) and `label_0`, `label_1`: 1 and 0 for the better and
the worse one, 0.5 each for a tie. A row without a label is left out. `user_id` is the labeler.
"""

from __future__ import annotations

import io
import math

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from prefrl.exchange.layout import Row, answer_of
from prefrl.types import Fields, Picture

LARGEST = 4096
"""Pixels of a side: a small file may hold a picture that fills the memory."""
SIDES = ("0", "1")


def picture_pair(row: Fields) -> list[Row | str]:
    """One comparison. Raises `ValueError` for what is no caption, no picture or no pair of labels."""
    if row.get("has_label") is False:
        return ["pair without a label"]
    caption = row.get("caption")
    if not isinstance(caption, str):
        raise ValueError(f"column 'caption': expected text, got {caption!r:.80}")
    first, second = (Picture(caption, read_picture(f"jpg_{side}", row.get(f"jpg_{side}"))) for side in SIDES)
    if first.id == second.id:
        return ["pair of equal pictures"]
    who = {"labeler": "" if row.get("user_id") is None else str(row["user_id"]), "query": row.get("query")}
    return [answer_of({"preference": _preference(row), **who}, [first, second])]


def _preference(row: Fields) -> float:
    found = [row.get(f"label_{side}") for side in SIDES]
    numbers = [float(x) for x in found if isinstance(x, int | float) and not isinstance(x, bool)]
    if len(numbers) < 2 or not math.isclose(sum(numbers), 1) or min(numbers) < 0:
        raise ValueError(
            f"columns 'label_0' and 'label_1': expected two numbers from 0 on that add up to 1, got {found}"
        )
    return numbers[0]


def read_picture(name: str, data: object) -> npt.NDArray[np.uint8]:
    """The pixels of a file: grey (H, W), or (H, W, 3)."""
    if not isinstance(data, bytes):
        raise ValueError(f"column {name!r}: expected the bytes of a picture, got {data!r:.80}")
    try:
        with Image.open(io.BytesIO(data)) as opened:
            if max(opened.size) > LARGEST:
                raise ValueError(f"column {name!r}: a picture of {opened.size} pixels; at most {LARGEST} a side")
            pixels = np.asarray(opened.convert("L" if opened.mode in ("L", "1") else "RGB"))
    except (OSError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError(f"column {name!r}: no picture that can be opened ({error})") from None
    return pixels.astype(np.uint8)
