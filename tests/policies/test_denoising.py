from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from prefrl.policies.denoising import DenoiserSettings

PICTURES = np.repeat(np.array([[1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0]], np.float32), 8, 0)


def settings(cache: Path, **changes: object) -> DenoiserSettings:
    small = {"steps": 5, "width": 32, "layers": 1, "batches": 400, "batch_size": 64, "learning_rate": 5e-3}
    return DenoiserSettings.model_validate({**small, "average": 0.9, "cache": cache, **changes})


def flat(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def test_it_learns_what_is_behind_the_noise(tmp_path: Path) -> None:
    model, noise = settings(tmp_path).build(PICTURES, 1), torch.randn(16, 4, generator=torch.Generator().manual_seed(0))
    clean, level = torch.from_numpy(PICTURES), torch.full((16,), 2)
    kept, lost = model.mixture(level)
    with torch.no_grad():
        found = model.clean(kept * clean + lost * noise, level, torch.zeros_like(level))
    assert float((found - clean).square().mean()) < 0.05


def test_it_is_trained_once_and_kept_and_a_damaged_one_is_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = settings(tmp_path).build(PICTURES, 1)
    assert "training a denoiser on 16 pictures" in capsys.readouterr().err
    second = settings(tmp_path).build(PICTURES, 3)
    assert capsys.readouterr().err == ""
    assert torch.equal(first.enter.weight, second.enter.weight)
    assert float(second.captions.weight.detach().abs().max()) == 0.0
    (file,) = tmp_path.glob("*/denoiser.safetensors")
    file.write_bytes(b"no longer")
    third = settings(tmp_path).build(PICTURES, 1)
    assert "is damaged" in capsys.readouterr().err
    assert torch.equal(flat(first), flat(third))


@pytest.mark.parametrize("changes", [{"seed": 1}, {"steps": 6}, {"learning_rate": 1e-3}])
def test_other_settings_or_pictures_are_another_denoiser(tmp_path: Path, changes: dict[str, object]) -> None:
    for one in (settings(tmp_path, batches=2), settings(tmp_path, batches=2, **changes)):
        one.build(PICTURES, 1)
    assert len(list(tmp_path.iterdir())) == 2
    settings(tmp_path, batches=2).build(-PICTURES, 1)
    assert len(list(tmp_path.iterdir())) == 3


def test_where_it_is_kept_does_not_change_it_nor_torchs_own_numbers(tmp_path: Path) -> None:
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    one, other = (settings(tmp_path / name, batches=3).build(PICTURES, 1) for name in ("a", "b"))
    assert torch.equal(torch.rand(1), expected)
    assert torch.equal(flat(one), flat(other))
