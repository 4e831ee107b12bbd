"""Arrays are filed under a sha256, and under nothing else."""

from pathlib import Path

import numpy as np
import pytest

from prefrl.storage.blobs import read_arrays, write_arrays
from prefrl.storage.files import DamagedError


@pytest.mark.parametrize(
    "id", ["../../secret", "/etc/passwd", "ab/../../../secret", "A" * 64, "a" * 63, "a" * 64 + "\n"]
)
def test_what_is_no_sha256_names_no_file(tmp_path: Path, id: str) -> None:
    """Ids come from files of others, and must not lead out of the folder."""
    with pytest.raises(DamagedError, match="names no file"):
        write_arrays(tmp_path / "blobs", id, {"gold": np.zeros(1)})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DamagedError, match="names no file"):
        read_arrays(tmp_path / "blobs", id)
